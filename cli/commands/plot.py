"""`daedalus plot`: draw the learning curves of one or more runs from their metrics.csv."""

import argparse
import csv
import math
import sys
from pathlib import Path

from daedalus.cli.arguments import command_parser
from daedalus.learner.run.run_directory import CONFIG, METRICS

_DESCRIPTION = "Draws return, entropy, value loss and policy lag of runs over their env_steps."

_EXAMPLES = """\
examples:
  daedalus plot runs/cartpole-impala-s1-20261121-101500 --output curve.png
  daedalus plot runs/cartpole-*-s1-* --output algorithms.png

exit status: 0 done, 1 failed, 2 bad usage"""

_PANELS = (
    ("episode_return_mean", "return (mean of the last episodes, band: one std; circles: evaluations)"),
    ("entropy", "entropy (nats)"),
    ("value_loss", "value loss"),
    ("policy_lag_mean", "policy lag (updates)"),
)


def parser() -> argparse.ArgumentParser:
    """Return the parser of `daedalus plot`."""
    options = command_parser("plot", _DESCRIPTION, _EXAMPLES)
    options.add_argument(
        "directories", nargs="+", type=Path, metavar="RUN_DIR", help="runs to draw, each in one colour"
    )
    options.add_argument(
        "--output", type=Path, required=True, metavar="FILE", help="picture to write: .png, .svg or .pdf"
    )
    return options


def plot(arguments: list[str]) -> int:
    """Run `daedalus plot` and return its exit status: 0 done, 1 failed."""
    parsed = parser().parse_args(arguments)
    try:
        runs = {directory.name: _read(directory) for directory in parsed.directories}
        _draw(runs, parsed.output)
    except ModuleNotFoundError:
        print('daedalus plot: matplotlib is not installed: pip install "daedalus-rl[plot]"', file=sys.stderr)
        return 1
    except (OSError, ValueError) as error:
        print(f"daedalus plot: {error}", file=sys.stderr)
        return 1
    print(f"wrote {parsed.output}")
    return 0


def _read(directory: Path) -> dict[str, list[float]]:
    """Return the columns of a run's metrics. Unknown values are NaN. Raises ValueError without metrics."""
    path = directory / METRICS
    if not path.exists():
        if not (directory / CONFIG).exists():
            raise ValueError(f"{directory} is not a run directory: it has neither {CONFIG} nor {METRICS}")
        raise ValueError(f"{directory} has no metrics yet: wait until the run has made its first updates")
    with open(path, newline="", encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    if not rows:
        raise ValueError(f"{directory} has no metrics yet: wait until the run has made its first updates")
    missing = {"env_steps", "episode_return_std", *(column for column, _ in _PANELS)} - rows[0].keys()
    if missing:
        raise ValueError(f"{path} has no column {min(missing)}: it is not the metrics of a run")
    return {name: [float(row[name]) if row[name] else float("nan") for row in rows] for name in rows[0]}


def _evaluations(run: dict[str, list[float]]) -> tuple[list[float], list[float]]:
    """Return the env_steps and mean returns of a run's evaluations, or empty lists if there are none."""
    env_steps, returns = run.get("evaluation_env_steps", []), run.get("evaluation_return_mean", [])
    by_env_steps = {at: mean for at, mean in zip(env_steps, returns, strict=True) if not math.isnan(at)}
    return list(by_env_steps), list(by_env_steps.values())


def _draw(runs: dict[str, dict[str, list[float]]], output: Path) -> None:
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(2, 2, figsize=(11, 7), sharex=True, layout="constrained")
    for axis, (column, title) in zip(axes.flat, _PANELS, strict=True):
        for label, run in runs.items():
            (line,) = axis.plot(run["env_steps"], run[column], label=label, linewidth=1.5)
            if column == "episode_return_mean":
                mean, std = run[column], run["episode_return_std"]
                low = [m - s for m, s in zip(mean, std, strict=True)]
                high = [m + s for m, s in zip(mean, std, strict=True)]
                axis.fill_between(run["env_steps"], low, high, color=line.get_color(), alpha=0.15, linewidth=0)
                axis.plot(*_evaluations(run), "o--", color=line.get_color(), linewidth=1, markersize=4)
        axis.set_title(title, fontsize=10)
        axis.grid(alpha=0.3)
    for axis in axes[1]:
        axis.set_xlabel("env_steps")
    axes[0, 0].legend(fontsize=8, loc="lower right")
    figure.savefig(output, dpi=110)
    plt.close(figure)
