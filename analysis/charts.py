"""Charts of runs."""

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from daedalus.analysis.comparison import final_returns, incomparable_returns, training_tasks
from daedalus.analysis.learning_curves import Series, evaluations, group_curve, points, series_of
from daedalus.analysis.markup import Child, Html, element
from daedalus.analysis.recorded_run import RETURN
from daedalus.analysis.run_groups import Group
from daedalus.analysis.statistics import performance_profile, profile_interval
from daedalus.learner.reporting.metrics import ENV, USER
from daedalus.learner.run.run_files import RunDataError
from daedalus.policy.saving.regular_files import replacing
from daedalus.protocol.texts import one_line, short_number

if TYPE_CHECKING:
    from matplotlib.axes import Axes

INSTALL = 'matplotlib is not installed: pip install "daedalus-rl[plot]"'
_SPREAD = "episode_return_std"
_PLOTTED = {
    RETURN: "return (mean of the last episodes, {})",
    "entropy": "entropy (nats)",
    "value_loss": "value loss",
    "policy_lag_mean": "policy lag (updates)",
}
COLUMNS = (*_PLOTTED, _SPREAD)  # that `draw_curves` needs
_THRESHOLDS = 200


def draw_curves(groups: Sequence[Group], output: Path, by: str) -> None:
    """Draw return, entropy, value loss and policy lag of groups, one curve each. Raises OSError, ModuleNotFoundError.

    Args:
      groups: a group of one run is drawn with the standard deviation of its episodes, and with its evaluations.
      output: .png, .svg or .pdf.
      by: "env_steps" or "minutes".
    """
    plt = _pyplot()
    figure, axes = plt.subplots(2, 2, figsize=(11, 7), sharex=True, layout="constrained")
    several = any(len(group.runs) > 1 for group in groups)
    band = "band: 95 % interval of the runs" if several else "band: one std; circles: evaluations"
    if len(training_tasks(groups)) > 1:
        band += "; different tasks in training"
    for axis, (column, title) in zip(axes.flat, _PLOTTED.items(), strict=True):
        for group in groups:
            if len(group.runs) > 1:
                _draw_group(axis, group, column, by)
            else:
                _draw_run(axis, group, column, by)
        axis.set_title(title.format(band), fontsize=10)
        axis.ticklabel_format(useOffset=False)  # an offset in a corner would hide what the ticks are
        axis.grid(alpha=0.3)
    for axis in axes[1]:
        axis.set_xlabel(by)
    axes[0, 0].legend(fontsize=8, loc="lower right")
    _save(figure, output)


def draw_profiles(groups: Sequence[Group], output: Path) -> None:
    """Draw the performance profile of each group: the share of its runs above a return.

    Raises RunDataError without any return, OSError and ModuleNotFoundError.
    """
    plt = _pyplot()
    evaluated = all(run.evaluation is not None for group in groups for run in group.runs)
    returns = [final_returns(group, evaluated=evaluated) for group in groups]
    if problem := incomparable_returns(groups):
        raise RunDataError(problem)
    every = np.concatenate(returns)
    every = every[~np.isnan(every)]
    if not len(every):
        raise RunDataError("no episode of these runs has ended: there is no final return")
    margin = (np.ptp(every) or abs(every[0]) or 1.0) * 0.05
    thresholds = np.linspace(every.min() - margin, every.max() + margin, _THRESHOLDS)
    figure, axis = plt.subplots(figsize=(7, 4.5), layout="constrained")
    for group, scores in zip(groups, returns, strict=True):
        (line,) = axis.plot(thresholds, performance_profile([scores], thresholds), label=_label(group))
        low, high = profile_interval([scores], thresholds)
        axis.fill_between(thresholds, low, high, color=line.get_color(), alpha=0.15, linewidth=0)
    axis.ticklabel_format(useOffset=False)
    axis.set_xlabel("return")
    axis.set_ylabel("share of runs with a higher final return")
    axis.set_title("performance profiles (band: 95 % interval)", fontsize=10)
    axis.grid(alpha=0.3)
    axis.legend(fontsize=8, loc="lower left")
    _save(figure, output)


def _label(group: Group) -> str:
    """Return the name of a group, printable, and no formula for matplotlib."""
    return one_line(group.name).replace("$", r"\$")


def _pyplot():
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    return plt


def _save(figure, output: Path) -> None:
    """Write the picture. Raises OSError."""
    import matplotlib.pyplot as plt

    try:
        with replacing(output) as beside:
            figure.savefig(beside, dpi=110, format=output.suffix[1:])
    finally:
        plt.close(figure)


def _draw_group(axis: "Axes", group: Group, column: str, by: str) -> None:
    curve = group_curve(group.runs, column, by)
    if curve is None:
        axis.plot([], label=_label(group))
        return
    (line,) = axis.plot(curve.x, curve.mean, label=f"{_label(group)} ({len(group.runs)} runs)", linewidth=1.5)
    axis.fill_between(curve.x, curve.low, curve.high, color=line.get_color(), alpha=0.15, linewidth=0)


def _draw_run(axis: "Axes", group: Group, column: str, by: str) -> None:
    (run,) = group.runs
    x, y = points(run, column, by)
    (line,) = axis.plot(x, y, label=_label(group), linewidth=1.5)
    if column == RETURN:
        std_x, std = points(run, _SPREAD, by)
        std = np.interp(x, std_x, std) if len(std) else np.zeros(len(x))
        axis.fill_between(x, y - std, y + std, color=line.get_color(), alpha=0.15, linewidth=0)
        axis.plot(*evaluations(run, by), "o--", color=line.get_color(), linewidth=1, markersize=4)


_STEPS = (1.0, 2.0, 5.0, 10.0)
_SUFFIXES = ((1e9, "G"), (1e6, "M"), (1e3, "k"))


@dataclass(frozen=True, slots=True, kw_only=True)
class Axis:
    """One axis: the numbers from `low` to `high` lie between the positions `begin` and `end`."""

    low: float
    high: float
    begin: float
    end: float
    ticks: Sequence[float]

    def at(self, values: np.ndarray | float) -> np.ndarray:
        """Return the positions of numbers."""
        return self.begin + (np.asarray(values) - self.low) / (self.high - self.low) * (self.end - self.begin)


def axis(low: float, high: float, begin: float, end: float, *, count: int, whole_steps: bool) -> Axis:
    """Return an axis for finite numbers from `low` to `high`.

    Args:
      low, high: the numbers that the axis must contain.
      begin, end: positions of the ends of the axis.
      count: the most ticks.
      whole_steps: begin and end the axis at a tick.
    """
    if not high - low > 1e-12 * max(abs(low), abs(high), 1e-30):  # of equal numbers, apart from rounding
        margin = abs(low) * 0.5 or 1.0
        low, high = low - margin, high + margin
    step = _step(high - low, count)
    if whole_steps:
        low, high = math.floor(low / step) * step, math.ceil(high / step) * step
    first = math.ceil(low / step - 1e-9)
    ticks = [index * step for index in range(first, math.floor(high / step + 1e-9) + 1)]
    return Axis(low=low, high=high, begin=begin, end=end, ticks=ticks)


def _step(span: float, count: int) -> float:
    """Return the smallest round step with at most `count` ticks over a span."""
    power = 10.0 ** math.floor(math.log10(span / count))
    return next((power * step for step in _STEPS if span / (power * step) <= count), power * 10.0)


def labels(ticks: Sequence[float]) -> list[str]:
    """Return numbers in few characters, but no two alike: 1500000 as 1.5M, 0.00025 as 0.00025, 1e-7 as 1e-07."""
    step = min((b - a for a, b in itertools.pairwise(ticks)), default=0.0)
    largest = max(map(abs, ticks), default=0.0)
    digits = max(4, math.ceil(math.log10(largest / step)) + 1) if 0.0 < step < largest else 4
    for size, suffix in _SUFFIXES:
        if digits <= 6 and largest >= size * (10 if suffix == "k" else 1):
            return ["0" if abs(tick) < step * 1e-6 else f"{tick / size:.{digits}g}{suffix}" for tick in ticks]
    return ["0" if abs(tick) < max(step * 1e-6, 1e-300) else f"{tick:.{digits}g}" for tick in ticks]


def written(value: float | None) -> str:
    """Return a number for a text or a table cell, whole ones without a point; `-` for None and NaN."""
    if value is None or math.isnan(value):
        return "-"
    whole = 10 <= abs(value) < 1e15 and float(value).is_integer()
    return f"{value:,.0f}" if whole else short_number(value)


SERIES_COLOURS = 8  # of style.css; further series repeat them with dashes

_WIDTH, _HEIGHT = 520.0, 220.0
_LEFT, _RIGHT, _TOP, _BOTTOM = 52.0, 508.0, 10.0, 184.0
_DIGIT_WIDTH = 7.0  # at most, of a label
_MOST_POINTS = 400
_MOST_BINS = 40


def line_chart(title: str, series: Sequence[Series], *, unit: str, colours: Sequence[int]) -> Html:
    """Return a chart of lines.

    Args:
      title: what the lines show.
      series: the lines, each with at least one point.
      unit: of the horizontal axis.
      colours: the colour of each line, from 0 on.
    """
    thinned = [_thinned(each) for each in series]
    across = _extent([each.x for each in thinned] + [each.marks[0] for each in thinned if each.marks])
    x = axis(*across, _LEFT, _RIGHT, count=6, whole_steps=False)
    heights = [part for each in thinned for part in (each.y, each.low, each.high, each.marks and each.marks[1])]
    low, high = _extent([part for part in heights if part is not None])
    margin = (high - low) * 0.05
    low = max(low - margin, 0.0) if low >= 0.0 else low - margin
    y = axis(low, high + margin, _BOTTOM, _TOP, count=5, whole_steps=False)
    drawn = [_line(each, x, y, colour) for each, colour in zip(thinned, colours, strict=True)]
    ends = "; ".join(
        f"{each.name + ': ' if len(series) > 1 else ''}from {written(float(each.y[0]))} to {written(float(each.y[-1]))}"
        for each in series[:SERIES_COLOURS]
    )
    return _figure(title, f"{title} by {unit}: {ends}", [_grid(x, y, unit), drawn], y)


def histogram(title: str, values: np.ndarray, *, marks: Sequence[tuple[str, float]], unit: str) -> Html:
    """Return a histogram of finite values, with vertical lines at named numbers."""
    counts, edges = np.histogram(values, _edges(values))
    x = axis(float(edges[0]), float(edges[-1]), _LEFT, _RIGHT, count=7, whole_steps=False)
    y = axis(0.0, float(counts.max()), _BOTTOM, _TOP, count=5, whole_steps=True)
    bars = [
        element(
            "rect",
            x=_short(x.at(low) + 0.75),
            y=_short(y.at(count)),
            width=_short(max(x.at(high) - x.at(low) - 1.5, 0.5)),
            height=_short(y.at(0.0) - y.at(count)),
            class_="bar",
        )
        for count, low, high in zip(counts, edges[:-1], edges[1:], strict=True)
        if count
    ]
    lines = [
        [
            element("line", x1=_short(x.at(at)), x2=_short(x.at(at)), y1=_TOP, y2=_BOTTOM, class_=f"mark-{index}"),
        ]
        for index, (_, at) in enumerate(marks)
    ]
    named = ", ".join(f"{name} {written(at)}" for name, at in marks)
    text = f"{title}: {len(values):,} from {written(values.min())} to {written(values.max())}, {named}"
    return _figure(title, text, [_grid(x, y, unit), bars, lines], y)


def _edges(values: np.ndarray) -> np.ndarray:
    """Return the edges of bins that hold all values: twice as many as Sturges' rule has, or one for equal values."""
    low, high = _extent([values])
    if high - low <= 1e-12 * max(abs(low), abs(high)):
        margin = max(0.5, 1e-6 * abs(low))
        return np.array([low - margin, high + margin])
    return np.linspace(low, high, min(2 * math.ceil(math.log2(len(values)) + 2), _MOST_BINS) + 1)


def _figure(title: str, description: str, content: Sequence[Child], y: Axis) -> Html:
    left = min(_LEFT - 6 - _DIGIT_WIDTH * max(map(len, labels(y.ticks))), 0.0)  # of the longest label
    return element(
        "figure",
        element("figcaption", title),
        element(
            "svg", content, viewBox=f"{left:g} 0 {_WIDTH - left:g} {_HEIGHT:g}", role="img", aria_label=description
        ),
        class_="chart",
    )


def _grid(x: Axis, y: Axis, unit: str) -> list[Html]:
    """Return the grid with the labels of its ticks."""
    lines = []
    for tick, label in zip(y.ticks, labels(y.ticks), strict=True):
        at = _short(y.at(tick))
        lines.append(element("line", x1=_LEFT, x2=_RIGHT, y1=at, y2=at, class_="grid"))
        lines.append(element("text", label, x=_LEFT - 6, y=float(at) + 4, text_anchor="end"))
    for tick, label in zip(x.ticks, labels(x.ticks), strict=True):
        at = _short(x.at(tick))
        lines.append(element("line", x1=at, x2=at, y1=_BOTTOM, y2=_BOTTOM + 4, class_="grid"))
        lines.append(element("text", label, x=at, y=_BOTTOM + 17, text_anchor="middle"))
    lines.append(element("text", unit, x=_RIGHT, y=_HEIGHT - 4, text_anchor="end", class_="unit"))
    return lines


def _line(series: Series, x: Axis, y: Axis, colour: int) -> list[Html | None]:
    style = f"series-{colour % SERIES_COLOURS + 1}"
    if colour >= SERIES_COLOURS:
        style += " dashed"
    band = marks = None
    if series.low is not None and series.high is not None:
        known = ~(np.isnan(series.low) | np.isnan(series.high))
        if known.any():
            upper = _points(x.at(series.x[known]), y.at(series.high[known]))
            lower = _points(x.at(series.x[known])[::-1], y.at(series.low[known])[::-1])
            band = element("path", d=f"M{upper}L{lower}Z", class_=f"band {style}")
    if len(series.x) == 1:  # a line of one point shows nothing
        line = element(
            "circle", cx=_short(x.at(series.x[0])), cy=_short(y.at(series.y[0])), r=3, class_=f"mark {style}"
        )
    else:
        line = element("path", d=f"M{_points(x.at(series.x), y.at(series.y))}", class_=f"line {style}")
    if series.marks is not None:
        marks = [
            element("circle", cx=_short(across), cy=_short(up), r=3.2, class_=f"mark {style}")
            for across, up in zip(x.at(series.marks[0]), y.at(series.marks[1]), strict=True)
        ]
    return [band, line, *(marks or [])]


def _points(across: np.ndarray, up: np.ndarray) -> str:
    return "L".join(f"{_short(a)},{_short(b)}" for a, b in zip(across, up, strict=True))


def _short(position: np.ndarray | float) -> str:
    return f"{float(position):.1f}"


def _extent(parts: Sequence[np.ndarray]) -> tuple[float, float]:
    values = np.concatenate([np.asarray(part, np.float64) for part in parts])
    values = values[np.isfinite(values)]
    return float(values.min()), float(values.max())


def _thinned(series: Series) -> Series:
    """Return a series with at most _MOST_POINTS points: the ends, and between them means of neighbours."""
    if len(series.x) <= _MOST_POINTS:
        return series
    inner = np.linspace(1, len(series.x) - 1, _MOST_POINTS - 2, endpoint=False).astype(np.int64)
    starts = np.concatenate([[0], inner, [len(series.x) - 1]])
    counts = np.diff(np.append(starts, len(series.x)))

    def mean(values: np.ndarray | None) -> np.ndarray | None:
        return None if values is None else np.add.reduceat(values, starts) / counts

    x, y = np.add.reduceat(series.x, starts) / counts, np.add.reduceat(series.y, starts) / counts
    return Series(name=series.name, x=x, y=y, low=mean(series.low), high=mean(series.high), marks=series.marks)


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
        found = [(series, index) for index, group in enumerate(groups) if (series := series_of(group, column, by))]
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
