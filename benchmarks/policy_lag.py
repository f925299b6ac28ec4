"""Measure which policy lag an algorithm bears: every rollout is played with weights of exactly so many updates ago.

    python -m benchmarks.policy_lag
    python -m benchmarks.policy_lag --preset acrobot --algorithm a3c --lags 0 8 32 --seeds 1 2 3 --env-steps 400000

One process collects and learns in turn, without a network, so that the lag is exact and a run is determined by its
seed. The result of a run is the env_steps until the target return, or the mean of the last training episodes at the end
of the budget.
"""

import argparse
import statistics

from benchmarks.running import machine, table
from benchmarks.study.exact_lag import train
from daedalus.learner.run.settings import choose_algorithm, read_preset, run_spec
from daedalus.learner.training.allocator import keep_freed_memory
from daedalus.protocol.spec import RunSpec


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
        runs = [train(spec, lag).counters for spec in specs]
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
