"""Axes of a chart: ticks at round numbers, their labels, and positions in the picture. Pure functions."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

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
    if not high - low > 1e-9 * max(abs(low), abs(high), 1e-30):
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


def label(value: float) -> str:
    """Return a number in few characters: 1500000 as 1.5M, 0.00025 as 0.00025, 1e-7 as 1e-07."""
    if abs(value) < 1e-12:
        return "0"
    for size, suffix in _SUFFIXES:
        if abs(value) >= size * (10 if suffix == "k" else 1):
            return f"{value / size:.4g}{suffix}"
    return f"{value:.4g}"


def written(value: float | None) -> str:
    """Return a number for a text or a table cell; `-` for None and NaN."""
    if value is None or math.isnan(value):
        return "-"
    if abs(value) >= 1e4 or (float(value).is_integer() and abs(value) >= 10):
        return f"{value:,.0f}"
    return f"{value:,.1f}" if abs(value) >= 10 else f"{value:.3g}"
