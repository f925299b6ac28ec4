"""Measure which policy lag an algorithm bears: every rollout is played with weights of exactly so many updates ago.

    python benchmarks/policy_lag.py
    python benchmarks/policy_lag.py --preset acrobot --algorithm a3c --lags 0 8 32 --seeds 1 2 3 --env-steps 400000

One process collects and learns in turn, without a network, so that the lag is exact and a run is determined by its
seed. The result of a run is the env_steps until the target return, or the mean of the last training episodes at the end
of the budget.
"""

import argparse
import statistics
from collections import deque

from running import machine, table

from daedalus.actor.collecting.environment_collector import EnvironmentCollector
from daedalus.learner.run.annealing import Annealing
from daedalus.learner.run.counters import RunCounters
from daedalus.learner.run.settings import choose_algorithm, read_preset, run_spec
from daedalus.learner.training.allocator import keep_freed_memory
from daedalus.learner.training.learner import Learner
from daedalus.policy.acting.runtime import OnnxRuntime
from daedalus.protocol.messages import RolloutIdentity, Snapshot
from daedalus.protocol.spec import RunSpec

_IDENTITY = RolloutIdentity(actor="a", incarnation=1, sequence=0, learner_epoch=1)


def train(spec: RunSpec, lag: int) -> RunCounters:
    """Train until the target or the end of the budget, with one rollout for each batch, and return the counters."""
    training = spec.training
    collector = EnvironmentCollector()
    spaces, _ = collector.prepare(spec)
    learner = Learner(training, spec.policy, spaces)
    collector.begin(OnnxRuntime(learner.program()), spec, training.seed)
    counters, annealing = RunCounters(training.target_episodes), Annealing(budget=training.env_steps)
    snapshots: deque[Snapshot] = deque(maxlen=lag + 1)
    while counters.env_steps < training.env_steps and not counters.reached(training.target_return):
        weights = {name: array.copy() for name, array in learner.weights().items()}
        version = learner.policy_version
        snapshots.append(Snapshot(learner_epoch=1, policy_version=version, program="", weights=weights))
        collector.load(snapshots[0])
        rollouts = [collector.collect(_IDENTITY)]
        progress = annealing.at(counters.env_steps)
        learner.step(rollouts, progress)
        counters.trained(rollouts, version, learner.policy_version - version)
    collector.close()
    return counters


def specification(parsed: argparse.Namespace, seed: int) -> RunSpec:
    """Return the specification of the runs with a seed."""
    settings = read_preset(parsed.preset)
    choose_algorithm(settings, parsed.algorithm)
    settings["training"]["seed"] = seed
    settings["training"].update({} if parsed.env_steps is None else {"env_steps": parsed.env_steps})
    return run_spec(settings)


def main() -> None:
    options = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    options.add_argument("--preset", default="cartpole")
    options.add_argument("--algorithm", default="a3c")
    options.add_argument("--lags", nargs="+", type=int, default=[0, 2, 4, 8, 16, 32])
    options.add_argument("--seeds", nargs="+", type=int, default=[1, 2, 3])
    options.add_argument("--env-steps", type=int, help="budget of each run (default: the preset's)")
    parsed = options.parse_args()
    keep_freed_memory()
    rows: list[tuple[object, ...]] = []
    specs = [specification(parsed, seed) for seed in parsed.seeds]
    target = specs[0].training.target_return
    for lag in parsed.lags:
        runs = [train(spec, lag) for spec in specs]
        solved = [run.env_steps for run in runs if run.reached(target)]
        ends = ", ".join(
            f"{run.env_steps:,}" if run.reached(target) else f"{run.episode_return_mean:.1f}" for run in runs
        )
        median = f"{statistics.median(solved):,.0f}" if solved else "-"
        rows.append((lag, f"{len(solved)} of {len(runs)}", median, ends))
        print(rows[-1], flush=True)
    print(machine())
    print(
        table(
            ("lag, updates", "solved", "env_steps to solved, median", "each run: env_steps, or mean at the end"), rows
        )
    )


if __name__ == "__main__":
    main()
