"""Learning curves of runs and of groups of runs over env_steps or minutes. Pure functions."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from daedalus.analysis.recorded_run import ENV_STEPS, RATING, RETURN, SECONDS, RecordedRun
from daedalus.analysis.run_groups import Group
from daedalus.analysis.statistics import interquartile_interval, interquartile_mean
from daedalus.learner.reporting.metrics_rows import WIN_RATE

STD, DEVIATION = "episode_return_std", "rating_deviation"
_BANDS = {RETURN: STD, RATING: DEVIATION}  # column that has half of the width, for the line of one run
LARGEST = 1e100  # larger numbers are left out: their distances overflow
_POINTS = 200


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Series:
    """One line of a chart, [points] each. The numbers are finite, except for those of a band that is unknown."""

    name: str
    x: np.ndarray
    y: np.ndarray
    low: np.ndarray | None = None
    high: np.ndarray | None = None
    marks: tuple[np.ndarray, np.ndarray] | None = None  # single points, such as evaluations: where they lie, values


def title_of(column: str) -> str:
    """Return what a column of the metrics shows, for a person."""
    opponent = column.removeprefix(WIN_RATE)
    return column if opponent == column else f"win rate against {opponent}"


def series_of(group: Group, column: str, by: str) -> Series | None:
    """Return the line of a group, or None if a run of it has no values.

    The line of several runs is their interquartile mean with its 95 % interval; the return of one run has the standard
    deviation of its episodes and its evaluations, and the rating its deviation.

    Args:
      group: the runs.
      column: column of their metrics.
      by: "env_steps" or "minutes".
    """
    if not all(column in run.metrics for run in group.runs):
        return None
    if len(group.runs) > 1:
        series = _group_series(group.name, group.runs, column, by)
    else:
        series = _run_series(group.name, group.runs[0], column, by)
    return None if series is None else _drawable(series)


def points(run: RecordedRun, column: str, by: str) -> tuple[np.ndarray, np.ndarray]:
    """Return where the known values of a column lie, [rows], increasing, and the values, [rows].

    Of several values at the same place, the newest counts. Args: as of `series_of`.
    """
    x = run.metrics[ENV_STEPS] if by == ENV_STEPS else run.metrics[SECONDS] / 60.0
    y = run.metrics[column]
    known = ~np.isnan(y) & ~np.isnan(x)
    x, y = x[known], y[known]
    newest = x < np.append(x[1:], np.inf)
    return x[newest], y[newest]


def evaluations(run: RecordedRun, by: str) -> tuple[np.ndarray, np.ndarray]:
    """Return where the evaluations of a run lie, [evaluations], and their mean returns, [evaluations]."""
    at, returns = run.metrics.get("evaluation_env_steps"), run.metrics.get("evaluation_return_mean")
    if at is None or returns is None:
        return np.zeros(0), np.zeros(0)
    by_env_steps = {env_steps: value for env_steps, value in zip(at, returns, strict=True) if not np.isnan(env_steps)}
    x = np.array(sorted(by_env_steps))  # several evaluators report in any order
    y = np.array([by_env_steps[env_steps] for env_steps in x])
    if by != ENV_STEPS and len(x):
        at_rows, seconds = points(run, SECONDS, ENV_STEPS)
        x = np.interp(x, at_rows, seconds) / 60.0 if len(at_rows) else np.full(len(x), np.nan)
    return x, y


def _group_series(name: str, runs: Sequence[RecordedRun], column: str, by: str) -> Series | None:
    """Return the interquartile mean of runs, or None if a run has no value.

    It begins where all runs have a value. A finished run keeps its last value, because runs that reach their target end
    early; the line ends where the first unfinished run ends.
    """
    lines = [points(run, column, by) for run in runs]
    if any(len(x) == 0 for x, _ in lines):
        return None
    begin = max(x[0] for x, _ in lines)
    last = [x[-1] for x, _ in lines]
    running = [end for end, run in zip(last, runs, strict=True) if run.unfinished or run.was_stopped]
    end = min([max(last), *running])
    if end < begin:
        return None
    grid = np.linspace(begin, end, _POINTS)
    values = np.stack([np.interp(grid, x, y) for x, y in lines])  # [runs, points]
    interval = interquartile_interval([values])
    return Series(name=name, x=grid, y=interquartile_mean(values, 0), low=interval.low, high=interval.high)


def _run_series(name: str, run: RecordedRun, column: str, by: str) -> Series:
    x, y = points(run, column, by)
    band = _BANDS.get(column)
    if band is None or band not in run.metrics:
        return Series(name=name, x=x, y=y)
    std_x, std = points(run, band, by)
    spread = np.interp(x, std_x, std) if len(std) else np.zeros(len(x))
    at, values = evaluations(run, by) if column == RETURN else (np.zeros(0), np.zeros(0))
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
