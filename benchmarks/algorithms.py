"""Measure learning of the presets whose runs take seconds or minutes: every algorithm on CartPole, and the others.

    python -m benchmarks.algorithms                          (the whole table)
    python -m benchmarks.algorithms --only acrobot           (one preset)

"Solved" is the moment when the mean of the last 100 training episodes reaches the target. That policy then plays 100
new sampled episodes, and the best checkpoint, or the newest, 100 new greedy ones.
"""

import argparse
import math
import statistics

from benchmarks.running import machine, table, train

RUNS = (
    ("cartpole", "a2c"),
    ("cartpole", "a3c"),
    ("cartpole", "impala"),
    ("cartpole", "appo"),
    ("cartpole", "n_step_q"),
    ("cartpole", "one_step_q"),
    ("cartpole", "one_step_sarsa"),
    ("acrobot", "impala"),
    ("acrobot", "appo"),
    ("lunar_lander", "appo"),
    ("cartpole_notes", "a2c"),
)
_COLUMNS = ("preset", "algorithm", "solved", "env_steps, median", "worst", "seconds, median")
_SCORES = ("sampled after solved: mean", "worst", "greedy: mean", "worst")


def main() -> None:
    options = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    options.add_argument("--only", nargs="+", choices=sorted({preset for preset, _ in RUNS}), help="presets to run")
    options.add_argument("--seeds", nargs="+", type=int, default=[11, 12, 13, 14, 15])
    parsed = options.parse_args()
    rows = []
    for preset, algorithm in RUNS:
        if parsed.only and preset not in parsed.only:
            continue
        summaries = [train(preset, "--algorithm", algorithm, "--seed", seed) for seed in parsed.seeds]
        solved = [summary for summary in summaries if summary["solved"]]
        steps = [summary["env_steps"] for summary in summaries]
        rows.append(
            (
                preset,
                algorithm,
                f"{len(solved)} of {len(summaries)}",
                f"{statistics.median(steps):,.0f}",
                f"{max(steps):,}",
                f"{statistics.median(summary['wall_seconds'] for summary in summaries):.1f}",
                *mean_and_worst([each["confirmation"]["return_mean"] for each in solved if each.get("confirmation")]),
                *mean_and_worst([summary["evaluation_return_mean"] for summary in summaries]),
            )
        )
        print(rows[-1], flush=True)
    print(machine())
    print(table((*_COLUMNS, *_SCORES), rows))


def mean_and_worst(scores: list[float]) -> tuple[str, str]:
    """Return the mean of the runs' scores and the lowest, as text; empty without a score."""
    scores = [score for score in scores if math.isfinite(score)]
    return (f"{statistics.fmean(scores):.1f}", f"{min(scores):.1f}") if scores else ("", "")


if __name__ == "__main__":
    main()
