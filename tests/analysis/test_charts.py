"""analysis/charts.py: histograms of any finite returns."""

import re

import numpy as np
import pytest

from daedalus.analysis.charts import axis, histogram, labels, line_chart
from daedalus.analysis.learning_curves import Series


@pytest.mark.parametrize(
    ("values", "bars"),
    [
        ([1.0], 1),
        ([0.0, 0.0], 1),
        ([500.0] * 100, 1),
        ([1e18] * 3, 1),
        ([1e99, 1e99], 1),
        ([1e18, 1e18 + 256.0], 1),
        ([-1e99, 1e99], 2),
        ([1e-300, 3e-300], 2),
        (list(range(1000)), 24),
        (list(range(100_000)), 38),
    ],
)
def test_histogram_holds_all_values(values: list[float], bars: int) -> None:
    chart = str(histogram("returns", np.array(values, np.float64), marks=[("mean", values[0])], unit="return"))
    assert len(re.findall("<rect", chart)) == bars
    assert f"{len(values):,} from" in chart
    assert "nan" not in chart
    assert "inf" not in chart


@pytest.mark.parametrize(
    ("low", "high"),
    [(1e9, 1e9 + 1), (1_000_001.0, 1_000_003.0), (-1e-9, 1e-9), (0.0, 2.0**33), (-500.0, 0.0), (7.0, 7.0)],
)
def test_ticks_have_labels_that_tell_them_apart(low: float, high: float) -> None:
    ticks = axis(low, high, 0.0, 1.0, count=5, whole_steps=False).ticks
    written = labels(ticks)
    sizes = {"k": 1e3, "M": 1e6, "G": 1e9}
    read = [float(text.rstrip("kMG")) * sizes.get(text[-1], 1.0) for text in written]
    assert len(ticks) >= 2
    assert read == pytest.approx(ticks, abs=(ticks[1] - ticks[0]) * 1e-3)


def test_the_ends_of_a_long_line_are_drawn_as_they_are() -> None:
    y = np.zeros(10_000)
    y[0], y[-1] = -300.0, 1_000_001.0
    chart = str(line_chart("return", [Series(name="a", x=np.arange(10_000.0), y=y)], unit="env_steps", colours=[0]))
    assert "from -300 to 1,000,001" in chart
