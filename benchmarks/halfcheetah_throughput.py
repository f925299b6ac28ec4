"""Measure env_steps/s on HalfCheetah-v5 with learning: Daedalus, PPO of stable-baselines3, and the limit.

    pip install -e ".[benchmark,mujoco]"
    python -m benchmarks.halfcheetah_throughput --rounds 3

Both make ten passes over each batch in minibatches of 64 rows, with 64 x 64 units for the policy and as many for the
value; everything else is the default of each. The limit is the speed of this machine's cores if they only stepped the
environments, ran the policy and made updates; each part is measured alone, on one core. All programs run in turn in
each round, and the ratios are computed per round.
"""

import argparse
import copy
import json
import os
import statistics
import subprocess
import sys
from pathlib import Path

import numpy as np
import torch

from benchmarks.random_actions import random_actions
from benchmarks.running import learning_rate, machine, per_call, table
from daedalus.actor.collecting.environment_collector import EnvironmentCollector
from daedalus.actor.environments.make import make_environments
from daedalus.learner.run.default_settings import default_settings
from daedalus.learner.run.process_resources import keep_freed_memory
from daedalus.learner.run.settings import run_spec
from daedalus.learner.training.learner import Learner
from daedalus.policy.acting.noise import draw_noise
from daedalus.policy.acting.runtime import OnnxRuntime
from daedalus.protocol.messages import Snapshot
from daedalus.protocol.spec import RunSpec
from daedalus.protocol.uploads import RolloutIdentity

_ID, _ROWS = "HalfCheetah-v5", 64
_MINIBATCHES = 32  # of a batch of 2 x 8 x 128 rows
_PEER = Path(__file__).parent / "peer.py"


def settings(backend: str) -> RunSpec:
    """Return the settings of our runs, with the environments of a backend."""
    bare = make_environments(run_spec({"environment": {"id": _ID}}).environment, 1)
    chosen = default_settings(bare.spaces)
    bare.close()
    chosen["environment"] = {**chosen.get("environment", {}), "id": _ID, "backend": backend}
    chosen["training"]["minibatches"] = _MINIBATCHES
    for other in ("for_algorithm", "with_memory"):
        chosen.pop(other, None)
    spec = run_spec(chosen)
    rows = spec.collection.actors * spec.collection.envs_per_actor * spec.collection.rollout_length
    if (rows, spec.training.passes) != (_ROWS * _MINIBATCHES, 10):
        raise SystemExit("the default settings have changed: adapt the number of minibatches")
    return spec


def ours(env_steps: int, backend: str) -> float:
    """Measure env_steps/s of `daedalus train` after the warm-up."""
    chosen = (f"training.minibatches={_MINIBATCHES}", f"environment.backend={backend}", "evaluation.final_episodes=1")
    return learning_rate("--env", _ID, "--env-steps", env_steps, *(word for each in chosen for word in ("--set", each)))


def peer(env_steps: int) -> float:
    """Measure env_steps/s of PPO of stable-baselines3."""
    command = [sys.executable, str(_PEER), "--env", _ID, "--env-steps", str(env_steps), "--seed", "1"]
    found = json.loads(subprocess.run(command, capture_output=True, text=True, check=True).stdout.splitlines()[-1])
    return found["env_steps"] / found["seconds"]


def limit(spec: RunSpec, seconds: float) -> tuple[float, dict[str, float]]:
    """Return the env_steps/s of all cores for the computations alone, and microseconds per env_step of each part."""
    count, random = spec.collection.envs_per_actor, np.random.default_rng(1)
    environments = make_environments(spec.environment, count)
    try:
        seen = environments.reset(1)
        spaces = environments.spaces
        actions = [random_actions(spaces, count, random) for _ in range(1000)]
        stepping = per_call(lambda index: environments.step(actions[index % 1000]), seconds)
    finally:
        environments.close()
    torch.set_num_threads(1)
    learner = Learner(spec.training, spec.policy, spaces)
    runtime = OnnxRuntime(learner.program())
    runtime.load(learner.weights())
    state, size = np.zeros((count, runtime.state_size), np.float32), runtime.noise_size
    acting = per_call(lambda _: runtime.act(seen.frames, state, draw_noise(size, count, random), seen.masks), seconds)
    collector = EnvironmentCollector()
    collector.prepare(spec.for_actors())
    collector.begin(runtime, spec.for_actors(), 1)
    collector.load(Snapshot(learner_epoch=1, policy_version=0, program="", weights=learner.weights()))
    identity = RolloutIdentity(actor="a", incarnation=1, sequence=0, learner_epoch=1)
    batch = [copy.deepcopy(collector.collect(identity, lambda: None)) for _ in range(spec.collection.actors)]
    collector.close()
    learning = per_call(lambda _: learner.step(batch, 0.1), 3 * seconds, warm_up=1) / len(batch)
    rows = count * spec.collection.rollout_length
    parts = {"environment": stepping / count, "forward": acting / count, "update": learning / rows}
    microseconds = {name: 1e6 * spent for name, spent in parts.items()}
    return 1e6 * (os.cpu_count() or 1) / sum(microseconds.values()), microseconds


def main() -> None:
    options = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    options.add_argument("--rounds", type=int, default=3)
    options.add_argument("--env-steps", type=int, default=750_000)
    options.add_argument("--peer-env-steps", type=int, default=50_000)
    options.add_argument("--seconds", type=float, default=3.0, help="duration of each part of the limit")
    options.add_argument(
        "--backend", choices=["gymnasium", "envpool"], default="gymnasium", help="ours; the peer's is gymnasium"
    )
    parsed = options.parse_args()
    keep_freed_memory()
    spec = settings(parsed.backend)
    rows, ratios, shares = [], [], []
    for index in range(parsed.rounds):
        most, parts = limit(spec, parsed.seconds)
        rate, other = ours(parsed.env_steps, parsed.backend), peer(parsed.peer_env_steps)
        ratios.append(rate / other)
        shares.append(rate / most)
        spent = " + ".join(f"{part:.0f}" for part in parts.values())
        cells = (f"{rate:,.0f}", f"{other:,.0f}", f"{ratios[-1]:.1f}", spent, f"{most:,.0f}", f"{shares[-1]:.0%}")
        rows.append((index + 1, *cells))
    print(machine())
    header = ("round", "env_steps/s", "stable-baselines3 PPO", "ratio")
    print(table((*header, "environment + forward + update, us", "limit, env_steps/s", "share"), rows))
    print(f"median {statistics.median(ratios):.1f} x PPO, {statistics.median(shares):.0%} of the limit")


if __name__ == "__main__":
    main()
