"""The curves of a report: which columns are drawn, and the lines of runs and of groups. Pure functions."""

from collections.abc import Sequence

import numpy as np

from daedalus.cli.comparing.curves import evaluations, group_curve, points
from daedalus.cli.comparing.grouping import Group
from daedalus.cli.comparing.recorded_run import RETURN, RecordedRun
from daedalus.cli.reports.charts import Series, line_chart
from daedalus.cli.reports.markup import Html, element
from daedalus.learner.reporting.metrics_rows import ENV, USER

_STD = "episode_return_std"
_TITLES = {
    RETURN: "return of the training episodes",
    "episode_length_mean": "length of the training episodes (env_steps)",
    "entropy": "entropy (nats)",
    "value_loss": "value loss",
    "policy_loss": "policy loss",
    "explained_variance": "explained variance of the returns",
    "policy_lag_mean": "policy lag (updates)",
    "behaviour_kl": "KL divergence of behaviour and target policy (nats)",
    "gradient_norm": "norm of the gradient",
    "learning_rate": "learning rate",
    "env_steps_per_second": "env_steps per second",
    "actors": "live actors",
    "rollouts_rejected": "rejected rollouts",
    "updates_skipped": "skipped updates",
}
_MOST_OWN = 24  # columns of the environment and of the user
LARGEST = 1e100  # larger numbers are left out: their distances overflow


def curves(groups: Sequence[Group], by: str) -> list[Html]:
    """Return a chart of each column that has values.

    Args:
      groups: one line each; a line of several runs is their interquartile mean with its 95 % interval.
      by: "env_steps" or "minutes".
    """
    columns = {name for group in groups for run in group.runs for name in run.metrics}
    own = sorted(name for name in columns if name.startswith((ENV, USER)))[:_MOST_OWN]
    charts = []
    for column, title in {**_TITLES, **{name: name for name in own}}.items():
        found = [(series, index) for index, group in enumerate(groups) if (series := _series(group, column, by))]
        if any(column == RETURN or series.y.any() for series, _ in found):  # all 0: nothing of the kind happened
            lines, colours = zip(*found, strict=True)
            charts.append(line_chart(title, lines, unit=by, colours=colours))
    return charts


def legend(groups: Sequence[Group]) -> Html:
    """Return the names of the lines, with their colours."""
    items = []
    for index, group in enumerate(groups):
        runs = f" ({len(group.runs)} runs)" if len(group.runs) > 1 else ""
        items.append(element("li", element("span", class_=f"key {_style(index)}"), f"{group.name}{runs}"))
    return element("ul", items, class_="legend")


def _style(index: int) -> str:
    return f"series-{index % 8 + 1}{' dashed' if index >= 8 else ''}"


def _series(group: Group, column: str, by: str) -> Series | None:
    """Return the line of a group, or None if a run of it has no values."""
    if not all(column in run.metrics for run in group.runs):
        return None
    if len(group.runs) > 1:
        curve = group_curve(group.runs, column, by)
        if curve is None:
            return None
        return _drawable(Series(name=group.name, x=curve.x, y=curve.mean, low=curve.low, high=curve.high))
    return _drawable(_run_series(group.name, group.runs[0], column, by))


def _run_series(name: str, run: RecordedRun, column: str, by: str) -> Series:
    """Return the line of one run; that of the return with its standard deviation and the evaluations."""
    x, y = points(run, column, by)
    if column != RETURN or _STD not in run.metrics:
        return Series(name=name, x=x, y=y)
    std_x, std = points(run, _STD, by)
    spread = np.interp(x, std_x, std) if len(std) else np.zeros(len(x))
    at, values = evaluations(run, by)
    known = (np.abs(values) < LARGEST) & (np.abs(at) < LARGEST)
    marks = (at[known], values[known]) if known.any() else None
    return Series(name=name, x=x, y=y, low=y - spread, high=y + spread, marks=marks)


def _drawable(series: Series) -> Series | None:
    """Return a series without the numbers that cannot be drawn, or None if nothing is left."""
    kept = (np.abs(series.x) < LARGEST) & (np.abs(series.y) < LARGEST)
    if not kept.any():
        return None

    def part(values: np.ndarray | None) -> np.ndarray | None:
        return None if values is None else np.where(np.abs(values[kept]) < LARGEST, values[kept], np.nan)

    low, high = part(series.low), part(series.high)
    return Series(name=series.name, x=series.x[kept], y=series.y[kept], low=low, high=high, marks=series.marks)
