"""Measure a learner on a GPU, in less than ten minutes: its tests, the learner alone, a fleet, Pong, and the limit.

    python -m benchmarks.gpu
    python -m benchmarks.gpu --device cpu --rows 256 --seconds 1 --parts learner fleet      (to try the script)

The learner alone makes updates of decoded rollouts, 16 rows of 16 environments each; the article's network with its GRU
learns from 15 rows of 256 environments. Pong is played with policies in the actors, and with twice as many actors whose
policies run in one process on the device. The limit is a plain torch loop on a batch that is on the device: the Nature
network with bfloat16, forward pass, backward pass and Adam, launched operation by operation and as a CUDA graph. Prints
Markdown tables for docs/results.md.
"""

import argparse
import os
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from benchmarks.fleet.__main__ import PIXELS_HEADER, PixelsFleet
from benchmarks.fleet.swarm import ENVIRONMENTS, PIXELS, recorded
from benchmarks.learner_speed import NETWORKS
from benchmarks.running import learning_rate, machine, table
from daedalus.algorithms.batch import BatchAssembler
from daedalus.learner.run.process_resources import keep_freed_memory
from daedalus.learner.run.settings import SettingsError
from daedalus.learner.training.learner import Learner
from daedalus.learner.training.update_graphs import check_device
from daedalus.policy.network.actor_critic import ActorCritic
from daedalus.protocol.spaces import Spaces
from daedalus.protocol.spec import PolicySpec, TrainingSpec
from daedalus.protocol.uploads import Rollout, RolloutIdentity

_ROWS = 16
_TESTS = ["tests/learner/test_cuda.py", "tests/learner/test_update_graphs.py"]
_PARTS = ("tests", "learner", "limit", "fleet", "pong")
_APPO = {"algorithm": "appo", "passes": 4, "minibatches": 4}


def wait(device: str) -> None:
    """Wait for the device."""
    if device == "cuda":
        torch.cuda.synchronize()


def rate(step: Callable[[], object], rows: int, device: str, seconds: float) -> float:
    """Return the rows per second of a step, after some that record and warm up."""
    for _ in range(12):
        step()
        if device == "cpu":
            break
    wait(device)
    steps, began = 0, time.monotonic()
    while time.monotonic() < began + seconds or not steps:
        step()
        steps += 1
    wait(device)
    return steps * rows / (time.monotonic() - began)


def rollouts_of(spaces: Spaces, rows: int, count: int, state_size: int) -> list[Rollout]:
    """Return rollouts of several actors, of 16 environments each."""
    random = np.random.default_rng(1)
    made = []
    for number in range(count):
        rollout = recorded(rows, PIXELS, seed=number)
        shape = (rows + 4, ENVIRONMENTS, *spaces.observations["observation"].shape)
        identity = RolloutIdentity(actor=f"a{number}", incarnation=1, sequence=0, learner_epoch=1)
        made.append(
            replace(
                rollout,
                identity=identity,
                frames={"observation": random.integers(0, 256, shape, np.uint8)},
                initial_state=np.zeros((ENVIRONMENTS, state_size), np.float32),
                rewards=random.normal(size=rollout.rewards.shape).astype(np.float32),
            )
        )
    return made


def learner_rate(
    policy: PolicySpec, spaces: Spaces, rows: int, width: int, device: str, seconds: float, **training: Any
) -> float:
    """Measure Learner.step, in rows per second."""
    spec = TrainingSpec.model_validate(
        {"device": device, "threads": os.cpu_count() if device == "cpu" else 1, **training}
    )
    learner = Learner(spec, policy, spaces)
    batch = rollouts_of(spaces, rows, width // ENVIRONMENTS, learner.state_size)
    found = rate(lambda: learner.step(batch, 0.1), rows * width, device, seconds)
    learner.finish()
    if learner.updates_skipped:
        raise SystemExit("updates were skipped: their gradients are not finite")
    return found


def learner_alone(device: str, rows: int, batch: int, seconds: float) -> float:
    """Return the rows per second of Learner.step with the settings of a fleet with pixels, on one thread of a CPU."""
    keep_freed_memory()
    policy, _, _, _ = NETWORKS["nature"]
    settings = {"algorithm": "impala", "batch_rollouts": batch, "threads": 1}
    return learner_rate(policy, PIXELS, rows, batch * ENVIRONMENTS, device, seconds, **settings)


def join_rate(width: int, device: str, seconds: float) -> float:
    """Measure the joining of rollouts alone, in rows per second."""
    batch, assembler = (
        rollouts_of(PIXELS, _ROWS, width // ENVIRONMENTS, 0),
        BatchAssembler(PIXELS, torch.device(device)),
    )
    return rate(lambda: assembler.join(batch), _ROWS * width, device, seconds)


def plain_loop(rows: int, device: str, seconds: float) -> tuple[float, float | None]:
    """Return the rows per second of a plain torch loop, operation by operation, and as a CUDA graph."""
    policy, _, _, _ = NETWORKS["nature"]
    network = ActorCritic(policy, PIXELS).to(device)
    parameters = list(network.learned_parameters())
    optimizer = torch.optim.Adam(parameters, 1e-4, capturable=device == "cuda", fused=True)
    seen = {"observation": torch.randint(0, 256, (1, rows, 4, 84, 84), dtype=torch.uint8, device=device)}
    state, starts = torch.zeros(rows, 0, device=device), torch.zeros(1, rows, dtype=torch.bool, device=device)
    actions = torch.randint(0, 6, (1, rows, 1), device=device)

    def update() -> None:
        with torch.autocast(device, torch.bfloat16, cache_enabled=False):
            logits, values = network(seen, state, starts)
        loss = values.square().mean() - logits.float().log_softmax(-1).gather(-1, actions).mean()
        optimizer.zero_grad(set_to_none=True)
        loss.backward()
        optimizer.step()

    if device == "cpu":
        return rate(update, rows, device, seconds), None
    side = torch.cuda.Stream()
    side.wait_stream(torch.cuda.current_stream())
    with torch.cuda.stream(side):
        for _ in range(5):
            update()
    torch.cuda.current_stream().wait_stream(side)
    eager = rate(update, rows, device, seconds)
    optimizer.zero_grad(set_to_none=True)
    graph = torch.cuda.CUDAGraph()
    with torch.cuda.graph(graph):
        update()
    return eager, rate(graph.replay, rows, device, seconds)


def learner_table(device: str, sizes: list[int], seconds: float, parts: list[str]) -> str:
    """Return the table of the learner alone, beside the limit."""
    policy, _, _, _ = NETWORKS["nature"]
    lines = []
    for rows in sizes:
        width = rows // _ROWS
        alone = "learner" in parts
        found: list[float | None] = [None] * 3
        if alone:
            found = [
                learner_rate(policy, PIXELS, _ROWS, width, device, seconds, algorithm="impala", batch_rollouts=1),
                learner_rate(policy, PIXELS, _ROWS, width, device, seconds, **_APPO),
                join_rate(width, device, seconds),
            ]
        found += plain_loop(rows, device, seconds) if "limit" in parts else (None, None)
        lines.append((f"{rows:,}", *("-" if each is None else f"{each:,.0f}" for each in found)))
    if "learner" in parts:
        policy, space, _, _ = NETWORKS["article, gru"]
        spaces = Spaces(observations={"observation": space}, actions=PIXELS.actions)
        width = 256 if device == "cuda" else 16
        found = [learner_rate(policy, spaces, 15, width, device, seconds, algorithm="impala")]
        lines.append((f"article, GRU: 15 x {width}", f"{found[0]:,.0f}", *"----"))
    header = ("rows of a batch", "impala, rows/s", "appo 4 x 4", "joining alone", "plain loop, eager", "CUDA graph")
    return table(header, lines)


def fleet_table(device: str, sizes: list[int], seconds: float, actors: int) -> str:
    """Return the table of simulated actors that send to the learner, for rollouts of 16 rows, then of 64."""
    lines = []
    for rows, length in [*((rows, _ROWS) for rows in sizes), (max(sizes), 4 * _ROWS)]:
        batch = max(rows // (length * ENVIRONMENTS), 1)
        limit = learner_alone(device, length, batch, seconds / 8)
        # While one actor of a process waits for its answer, the other sends.
        fleet = PixelsFleet(device=device, batch=batch, seconds=seconds, per_process=2, rows=length, limit=limit)
        lines.append((length, *fleet.measured(2 * actors)))
    return table(("rows of a rollout", *PIXELS_HEADER), lines)


def pong(device: str, env_steps: int, actors: int, inference: str) -> float:
    """Measure env_steps/s of `daedalus train pong` with the Nature network, after the warm-up."""
    settings = {
        "policy.encoder": "nature",
        "collection.actors": actors,
        "collection.envs_per_actor": 16,
        "collection.rollout_length": 16,
        "training.algorithm": "impala",
        "training.passes": 1,
        "training.minibatches": 1,
        "training.device": device,
        "training.stop_when_solved": "false",
        "evaluation.seconds": 1e6,
        "evaluation.final_episodes": 1,
    }
    words = [word for name, value in settings.items() for word in ("--set", f"{name}={value}")]
    return learning_rate("pong", "--env-steps", env_steps, "--inference", inference, *words)


def main() -> None:
    options = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    options.add_argument("--device", choices=("cpu", "cuda"), default="cuda")
    options.add_argument("--parts", nargs="+", choices=_PARTS, default=list(_PARTS))
    options.add_argument("--rows", nargs="+", type=int, default=[256, 1024, 4096])
    options.add_argument("--seconds", type=float, default=4.0, help="duration of each measurement of the learner")
    options.add_argument("--fleet-seconds", type=float, default=25.0)
    options.add_argument(
        "--actors",
        type=int,
        default=max((os.cpu_count() or 2) - 2, 2),
        help="of Pong, and half of those of the fleet and of Pong with one process for the policies",
    )
    options.add_argument("--env-steps", type=int, default=1_000_000, help="of Pong")
    parsed = options.parse_args()
    if parsed.device == "cuda":
        try:
            check_device("auto")
        except SettingsError as error:
            options.error(str(error))
    keep_freed_memory()
    torch.set_num_threads(1)
    card = torch.cuda.get_device_name() if parsed.device == "cuda" else "no GPU"
    print(f"{machine()}, {card}, torch {torch.__version__}\n", flush=True)
    root = Path(__file__).parents[1]
    if "tests" in parsed.parts:
        made = subprocess.run([sys.executable, "-m", "pytest", "-q", *_TESTS], cwd=root, check=False)
        print("tests passed\n" if made.returncode == 0 else "tests FAILED\n", flush=True)
    if {"learner", "limit"} & set(parsed.parts):
        print(learner_table(parsed.device, parsed.rows, parsed.seconds, parsed.parts), "\n", flush=True)
    if "fleet" in parsed.parts:
        print(fleet_table(parsed.device, parsed.rows, parsed.fleet_seconds, parsed.actors), "\n", flush=True)
    if "pong" in parsed.parts:
        one_process = "cuda" if parsed.device == "cuda" else "shared"
        for actors, inference in ((parsed.actors, "local"), (2 * parsed.actors, one_process)):
            speed = pong(parsed.device, parsed.env_steps, actors, inference)
            print(f"Pong with {actors} actors, --inference {inference}: {speed:,.0f} env_steps/s", flush=True)


if __name__ == "__main__":
    main()
