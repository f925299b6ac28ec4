"""Measure the seconds from the start of `daedalus train cartpole` until it is solved, one run per seed.

    python -m benchmarks.solve_time --seeds 1 2 3 4 5

Solved means that the mean of the last 100 training episodes is at least 475, as in the preset, and that 100 new
episodes confirm it. The time starts with the `daedalus` process. It includes attempts that were not confirmed, but not
the confirmation of the last one and not the final evaluation. One run before the others warms the disk cache; it is
not counted.
"""

import argparse
import statistics

from benchmarks.running import machine, table, train


def main() -> None:
    options = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    options.add_argument("--seeds", type=int, nargs="+", default=[1, 2, 3, 4, 5])
    options.add_argument("--preset", default="cartpole")
    parsed = options.parse_args()
    train(parsed.preset, "--seed", 1000)
    rows, seconds = [], []
    for seed in parsed.seeds:
        summary = train(parsed.preset, "--seed", seed)
        seconds.append(summary["seconds_to_target"] or float("inf"))
        scores = [f"{summary[name] or 0.0:.1f}" for name in ("confirmation_return_mean", "evaluation_return_mean")]
        rows.append((seed, f"{seconds[-1]:.2f}", f"{summary['env_steps']:,}", *scores))
    print(machine())
    print(table(("seed", "seconds to solved", "env_steps", "confirmation (sampled, 100)", "greedy, 100"), rows))
    print(f"median {statistics.median(seconds):.2f} s, worst {max(seconds):.2f} s")


if __name__ == "__main__":
    main()
