"""Axes of a chart: ticks at round numbers, their labels, and positions in the picture. Pure functions."""

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from daedalus.protocol.texts import short_number

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
