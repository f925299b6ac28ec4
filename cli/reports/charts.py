"""Charts as SVG: lines with bands over env_steps or minutes, and histograms. Pure functions."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from daedalus.cli.reports.axes import Axis, axis, labels, written
from daedalus.cli.reports.markup import Child, Html, element

SERIES_COLOURS = 8  # of style.css; further series repeat them with dashes

_WIDTH, _HEIGHT = 520.0, 220.0
_LEFT, _RIGHT, _TOP, _BOTTOM = 52.0, 508.0, 10.0, 184.0
_DIGIT_WIDTH = 7.0  # at most, of a label
_MOST_POINTS = 400
_MOST_BINS = 40


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Series:
    """One line of a chart, [points] each. The numbers are finite, except for those of a band that is unknown."""

    name: str
    x: np.ndarray
    y: np.ndarray
    low: np.ndarray | None = None
    high: np.ndarray | None = None
    marks: tuple[np.ndarray, np.ndarray] | None = None  # single points, such as evaluations: where they lie, values


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
