"""Measure learning of the presets: every algorithm on CartPole, and the other presets, over several seeds.

python -m benchmarks.algorithms                          (the whole table)
python -m benchmarks.algorithms --only acrobot           (one preset)
"""

import argparse
import statistics

from benchmarks.running import machine, table, train

RUNS = (
    ("cartpole", "a2c", (1, 2, 3, 4, 5)),
    ("cartpole", "a3c", (1, 2, 3, 4, 5)),
    ("cartpole", "impala", (1, 2, 3, 4, 5)),
    ("cartpole", "n_step_q", (1, 2, 3, 4, 5)),
    ("cartpole", "one_step_q", (1, 2, 3, 4, 5)),
    ("cartpole", "one_step_sarsa", (1, 2, 3, 4, 5)),
    ("acrobot", "impala", (1, 2, 3)),
    ("lunar_lander", "appo", (1, 2, 3)),
    ("cartpole_notes", "a2c", (1, 2, 3)),
)


def main() -> None:
    options = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    options.add_argument("--only", nargs="+", help="presets to run")
    parsed = options.parse_args()
    rows = []
    for preset, algorithm, seeds in RUNS:
        if parsed.only and preset not in parsed.only:
            continue
        summaries = [train(preset, "--algorithm", algorithm, "--seed", seed) for seed in seeds]
        solved = [summary for summary in summaries if summary["solved"]]
        steps = [summary["env_steps"] for summary in summaries]
        evaluations = [summary["evaluation_return_mean"] for summary in summaries]
        rows.append(
            (
                preset,
                algorithm,
                f"{len(solved)} of {len(seeds)}",
                f"{statistics.median(steps):,.0f}",
                f"{max(steps):,}",
                f"{statistics.median(summary['wall_seconds'] for summary in summaries):.1f}",
                f"{statistics.median(evaluations):.1f}",
                f"{min(evaluations):.1f}",
            )
        )
        print(rows[-1], flush=True)
    print(machine())
    columns = ("preset", "algorithm", "solved", "env_steps, median", "worst", "seconds, median")
    print(table((*columns, "evaluation, median", "worst"), rows))


if __name__ == "__main__":
    main()
