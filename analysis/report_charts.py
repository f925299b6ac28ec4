"""The charts of a report: elements of SVG, which a browser writes in its own font and colours. Pure functions.

Colours are variables of the report's style sheet, which has others for a dark page. A report needs no extra package, so
that every run can leave one.
"""

import math
import xml.etree.ElementTree as ET
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from daedalus.analysis.learning_curves import Series
from daedalus.analysis.run_results import written

SERIES_COLOURS = 8  # further series repeat them with dashes
SMALL, MEDIUM, LARGE = (
    (400, 180),
    (600, 240),
    (1180, 340),
)  # width and height of a chart, in pixels where the page is not scaled
_TOP, _RIGHT, _BOTTOM = 8, 12, 34  # margins; the left one is as wide as the labels
_CHARACTER = 6.6  # width of one of a label
_SUFFIXES = ((1e12, "T"), (1e9, "G"), (1e6, "M"), (1e3, "k"))
_MOST_POINTS = 400
_MOST_BINS = 40


def line_chart(
    title: str, series: Sequence[Series], *, unit: str, colours: Sequence[int], size: tuple[int, int] = SMALL
) -> ET.Element:
    """Return a chart of lines as an element `svg`.

    Args:
      title: what the lines show.
      series: the lines, each with at least one point.
      unit: of the horizontal axis.
      colours: the colour of each line, from 0 on.
      size: width and height.
    """
    ends = "; ".join(
        f"{each.name + ': ' if len(series) > 1 else ''}from {written(float(each.y[0]))} to {written(float(each.y[-1]))}"
        for each in series[:SERIES_COLOURS]
    )
    lines = [_thinned(each) for each in series]
    marks = [each.marks for each in lines if each.marks is not None]
    xs = np.concatenate([*(each.x for each in lines), *(at for at, _ in marks)])
    bands = [part for each in lines for part in (each.low, each.high) if part is not None]
    ys = np.concatenate([*(each.y for each in lines), *bands, *(values for _, values in marks)])
    frame = _Frame.around(xs, ys[np.isfinite(ys)], size)
    svg = frame.svg(f"{title} by {unit}: {ends}", unit)
    for each, colour in zip(lines, colours, strict=True):
        stroke = f"var(--series-{colour % SERIES_COLOURS + 1})"
        if each.low is not None and each.high is not None:
            known = np.isfinite(each.low) & np.isfinite(each.high)
            around = np.append(each.x[known], each.x[known][::-1])
            edge = np.append(each.high[known], each.low[known][::-1])
            _add(svg, "path", d=frame.path(around, edge), style=f"fill: {stroke}; opacity: 0.15")
        dashed = "; stroke-dasharray: 6 4" if colour >= SERIES_COLOURS else ""
        _add(
            svg, "path", d=frame.path(each.x, each.y), style=f"fill: none; stroke: {stroke}; stroke-width: 1.6{dashed}"
        )
        points = [(each.x, each.y)] if len(each.x) == 1 else []  # a line of one point shows nothing
        for at, values in [*points, *([each.marks] if each.marks is not None else [])]:
            for x, y in zip(at.tolist(), values.tolist(), strict=True):
                _add(svg, "circle", cx=frame.x(x), cy=frame.y(y), r="2.5", style=f"fill: {stroke}")
    return svg


def histogram(title: str, values: np.ndarray, *, marks: Sequence[tuple[str, float]], unit: str) -> ET.Element:
    """Return a histogram of finite values, with vertical lines at named numbers, as an element `svg`."""
    named = ", ".join(f"{name} {written(at)}" for name, at in marks)
    text = f"{title}: {len(values):,} from {written(values.min())} to {written(values.max())}, {named}"
    counts, edges = np.histogram(values, _edges(values))
    frame = _Frame.around(edges, np.array([0.0, counts.max()]), MEDIUM, pads=False)
    svg = frame.svg(text, unit)
    for count, left, right in zip(counts.tolist(), edges[:-1].tolist(), edges[1:].tolist(), strict=True):
        corners = frame.path(np.array([left, left, right, right]), np.array([0.0, count, count, 0.0]))
        _add(svg, "path", d=f"{corners} Z", style="fill: var(--bar); stroke: var(--panel)")
    for index, (_, at) in enumerate(marks):
        ends = frame.path(np.array([at, at]), np.array([0.0, counts.max()]))
        dashes = "; stroke-dasharray: 6 4" if index else ""
        _add(svg, "path", d=ends, style=f"fill: none; stroke: var(--series-{index + 2}); stroke-width: 1.8{dashes}")
    return svg


def ticks(low: float, high: float, count: int) -> list[float]:
    """Return round numbers between two ends, at most about `count` of them."""
    rough = (high - low) / count
    power = 10.0 ** math.floor(math.log10(rough))
    step = next(factor * power for factor in (1.0, 2.0, 5.0, 10.0) if factor * power >= rough * (1.0 - 1e-9))
    first = math.ceil(low / step - 1e-9)
    return [index * step for index in range(first, math.floor(high / step + 1e-9) + 1)]


def labels(values: Sequence[float]) -> list[str]:
    """Return the texts of ticks: different ones, with as few digits as that takes."""
    largest = max((abs(value) for value in values), default=0.0)
    step = abs(values[1] - values[0]) if len(values) > 1 else largest
    units = [(unit, suffix) for unit, suffix in _SUFFIXES if 1e4 <= largest < 1e15 and largest >= unit]
    unit, suffix = units[0] if units else (1.0, "")
    digits = math.ceil(math.log10(largest / step) - 1e-9) + 1 if step > 0.0 else 3
    if largest and not 1e-3 <= largest < 1e15:
        return [f"{value:.{max(digits, 1)}g}" for value in values]
    places = max(0, -math.floor(math.log10(step / unit) + 1e-9)) if step > 0.0 else 0
    return [f"{value / unit:,.{places}f}{suffix if value else ''}" for value in values]


@dataclass(frozen=True, slots=True)
class _Frame:
    """The axes of one chart."""

    left: float
    size: tuple[int, int]
    xs: tuple[float, float]  # the ends of the horizontal axis
    ys: tuple[float, float]

    @classmethod
    def around(cls, x: np.ndarray, y: np.ndarray, size: tuple[int, int], *, pads: bool = True) -> "_Frame":
        """Return the axes that hold all points; `pads` leaves room above and below them."""
        xs, ys = _ends(x), _ends(y)
        if pads:
            margin = 0.04 * (ys[1] - ys[0])
            ys = ys[0] - margin, ys[1] + margin
        names = labels(ticks(*ys, _rows(size)))
        return cls(10 + _CHARACTER * max(map(len, names), default=1), size, xs, ys)

    def x(self, value: float) -> str:
        """Return where a number lies."""
        share = (value - self.xs[0]) / (self.xs[1] - self.xs[0])
        return f"{self.left + share * (self.size[0] - _RIGHT - self.left):.1f}"

    def y(self, value: float) -> str:
        """Return where a number lies."""
        share = (value - self.ys[0]) / (self.ys[1] - self.ys[0])
        return f"{(self.size[1] - _BOTTOM) - share * (self.size[1] - _BOTTOM - _TOP):.1f}"

    def path(self, x: np.ndarray, y: np.ndarray) -> str:
        """Return a line through points."""
        points = zip(map(self.x, x.tolist()), map(self.y, y.tolist()), strict=True)
        return " ".join(f"{'L' if index else 'M'} {at} {value}" for index, (at, value) in enumerate(points))

    def svg(self, description: str, unit: str) -> ET.Element:
        """Return the element with the axes."""
        width, height = self.size
        viewed = {"viewBox": f"0 0 {width} {height}", "role": "img", "aria-label": description}
        svg = ET.Element("svg", viewed)
        right = f"{width - _RIGHT}"
        values = ticks(*self.ys, _rows(self.size))
        for value, name in zip(values, labels(values), strict=True):
            at = self.y(value)
            _add(svg, "path", d=f"M {self.left:.1f} {at} L {right} {at}", style="stroke: var(--grid)")
            _add(svg, "text", name, x=f"{self.left - 6:.1f}", y=f"{float(at) + 4:.1f}", style="text-anchor: end")
        values = ticks(*self.xs, max(3, width // 110))
        for value, name in zip(values, labels(values), strict=True):
            half = _CHARACTER * len(name) / 2
            at = min(float(self.x(value)), width - half)
            _add(svg, "text", name, x=f"{at:.1f}", y=f"{height - _BOTTOM + 15}", style="text-anchor: middle")
        _add(svg, "text", unit, x=right, y=f"{height - 4}", style="text-anchor: end")
        return svg


def _rows(size: tuple[int, int]) -> int:
    return max(4, size[1] // 50)


def _ends(values: np.ndarray) -> tuple[float, float]:
    """Return the lowest and the highest value, or two around them if they are equal."""
    low, high = float(values.min()), float(values.max())
    if high - low <= 1e-12 * max(abs(low), abs(high)) or high - low < 1e-290:
        margin = max(0.05 * abs(low), 1e-6) if low else 1.0
        return low - margin, high + margin
    return low, high


def _add(svg: ET.Element, name: str, text: str | None = None, **attributes: str) -> None:
    ET.SubElement(svg, name, attributes).text = text


def _edges(values: np.ndarray) -> np.ndarray:
    """Return the edges of bins that hold all values: twice as many as Sturges' rule has, or one for equal values."""
    low, high = float(values.min()), float(values.max())
    if high - low <= 1e-12 * max(abs(low), abs(high)):
        margin = max(0.5, 1e-6 * abs(low))
        return np.array([low - margin, high + margin])
    return np.linspace(low, high, min(2 * math.ceil(math.log2(len(values)) + 2), _MOST_BINS) + 1)


def _thinned(series: Series) -> Series:
    """Return a series with at most _MOST_POINTS points: the ends, and between them means of neighbours."""
    if len(series.x) <= _MOST_POINTS:
        return series
    inner = np.linspace(1, len(series.x) - 1, _MOST_POINTS - 2, endpoint=False).astype(np.int64)
    starts = np.concatenate([[0], inner, [len(series.x) - 1]])
    counts = np.diff(np.append(starts, len(series.x)))
    columns = {name: getattr(series, name) for name in ("x", "y", "low", "high")}
    means = {name: np.add.reduceat(part, starts) / counts for name, part in columns.items() if part is not None}
    return replace(series, **means)
