"""Measure env_steps/s on Pong with learning: Daedalus, its peers, and the limit of the pure computations.

    python -m benchmarks.pong_throughput --rounds 3
    python -m benchmarks.pong_throughput --sample-factory PLACE/bin/python       (peer_appo.py describes PLACE)

Peers are A2C of stable-baselines3 and, with --sample-factory, APPO of Sample Factory. The ratio is to the faster peer.
All use 84 x 84 grey frames, skip 4, stack 4, Nature CNN, 256 rows per update and one pass. The limit is the speed of
this machine's cores if they only stepped the environments, ran the policy and made updates; each part is measured
alone, on one core. All programs run in turn in each round, and the ratios are computed per round.
"""

import argparse
import os
import statistics
import subprocess
import sys
from pathlib import Path

import numpy as np
import torch

from benchmarks.learner_speed import NETWORKS, fastest, updater
from benchmarks.random_actions import random_actions
from benchmarks.running import learning_rate, machine, per_call, table
from daedalus.actor.environments.make import make_environments
from daedalus.learner.run.process_resources import keep_freed_memory
from daedalus.learner.run.settings import read_preset, run_spec
from daedalus.policy.acting.noise import draw_noise
from daedalus.policy.acting.program import export_program
from daedalus.policy.acting.runtime import OnnxRuntime
from daedalus.policy.network.actor_critic import ActorCritic
from daedalus.protocol.spaces import Spaces

ENVIRONMENTS, ROWS = 16, 16  # of an actor; one rollout is the batch of one update
SETTINGS = {
    "policy.encoder": "nature",
    "collection.envs_per_actor": ENVIRONMENTS,
    "collection.rollout_length": ROWS,
    "training.algorithm": "impala",
    "training.batch_rollouts": 1,
    "training.passes": 1,
    "training.minibatches": 1,
    "training.stop_when_solved": "false",
    "evaluation.seconds": 1e6,
    "evaluation.final_episodes": 1,
}


def ours(backend: str, env_steps: int) -> float:
    """Measure env_steps/s of `daedalus train pong` after the warm-up."""
    settings = {"environment.backend": backend, **SETTINGS}
    changed = [word for name, value in settings.items() for word in ("--set", f"{name}={value}")]
    return learning_rate("pong", "--env-steps", env_steps, *changed)


def peer(python: str, script: str, *options: str) -> float:
    """Measure env_steps/s of a peer."""
    command = [python, str(Path(__file__).parent / script), *options]
    return float(subprocess.run(command, capture_output=True, text=True, check=True).stdout.split()[-1])


def limit(backend: str, seconds: float) -> tuple[float, dict[str, float]]:
    """Return the env_steps/s of all cores for the computations alone, and microseconds per env_step of each part."""
    spec = run_spec(read_preset("pong")).environment.model_copy(update={"backend": backend})
    environments = make_environments(spec, ENVIRONMENTS)
    try:
        environments.reset(1)
        spaces, random = environments.spaces, np.random.default_rng(1)
        actions = [random_actions(spaces, ENVIRONMENTS, random) for _ in range(1000)]
        stepping = per_call(lambda index: environments.step(actions[index % 1000]), seconds)
    finally:
        environments.close()
    policy, space, _, _ = NETWORKS["nature"]
    spaces = Spaces(observations={"observation": space}, actions=spaces.actions)
    network = ActorCritic(policy, spaces)
    runtime = OnnxRuntime(export_program(network, spaces))
    runtime.load({name: parameter.detach().numpy() for name, parameter in network.named_parameters()})
    random = np.random.default_rng(1)
    seen = {"observation": random.integers(0, 256, (ENVIRONMENTS, *space.stacked_shape), dtype=np.uint8)}
    state = np.zeros((ENVIRONMENTS, network.state_size), np.float32)
    size = runtime.noise_size
    acting = per_call(lambda _: runtime.act(seen, state, draw_noise(size, ENVIRONMENTS, random), {}), seconds)
    torch.set_num_threads(1)
    learning = fastest(updater(policy, space, ROWS, ENVIRONMENTS, bfloat16=True), seconds) / ROWS
    parts = {"environment": stepping, "forward": acting, "update": learning}
    microseconds = {name: 1e6 * spent / ENVIRONMENTS for name, spent in parts.items()}
    return 1e6 * (os.cpu_count() or 1) / sum(microseconds.values()), microseconds


def main() -> None:
    options = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    options.add_argument("--rounds", type=int, default=3)
    options.add_argument("--env-steps", type=int, default=120_000)
    options.add_argument("--peer-env-steps", type=int, default=20_000)
    options.add_argument("--backend", choices=("envpool", "ale"), default="envpool")
    options.add_argument(
        "--seconds", type=float, default=5.0, help="duration of the measurement of each part of the limit"
    )
    options.add_argument("--sample-factory", metavar="PYTHON", help="Python with Sample Factory, see peer_appo.py")
    parsed = options.parse_args()
    keep_freed_memory()
    steps = ("--env-steps", str(parsed.peer_env_steps))
    peers = {"stable-baselines3 A2C": [sys.executable, "peer_a2c.py", "--pong", *steps]}
    if parsed.sample_factory:
        peers["Sample Factory APPO"] = [parsed.sample_factory, "peer_appo.py", *steps]
    rows, ratios, shares = [], [], []
    for index in range(parsed.rounds):
        most, parts = limit(parsed.backend, parsed.seconds)
        rate, others = ours(parsed.backend, parsed.env_steps), [peer(*command) for command in peers.values()]
        ratios.append(rate / max(others))
        shares.append(rate / most)
        rates = [f"{each:,.0f}" for each in (rate, *others)]
        spent = " + ".join(f"{part:.0f}" for part in parts.values())
        rows.append((index + 1, *rates, f"{ratios[-1]:.1f}", spent, f"{most:,.0f}", f"{shares[-1]:.0%}"))
    print(machine())
    header = ("round", "env_steps/s", *peers, "ratio to the faster peer")
    header += ("environment + forward + update, us", "limit, env_steps/s", "share")
    print(table(header, rows))
    print(f"median {statistics.median(ratios):.1f} x the faster peer, {statistics.median(shares):.0%} of the limit")


if __name__ == "__main__":
    main()
