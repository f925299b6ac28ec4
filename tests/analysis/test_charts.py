"""analysis/charts.py: charts of any finite numbers, as matplotlib draws them for a report."""

import re
import xml.etree.ElementTree as ET

import numpy as np
import pytest

from daedalus.analysis.charts import histogram, line_chart
from daedalus.analysis.learning_curves import Series

pytest.importorskip("matplotlib")


def drawn(chart: ET.Element, colour: str) -> list[str]:
    """Return the shapes of a chart that are filled or drawn with a colour of the style sheet."""
    assert not re.search(r'="[^"]*(nan|inf)', ET.tostring(chart, "unicode"))
    return [each.get("d", "") for each in chart.iter("path") if f"var(--{colour})" in each.get("style", "")]


@pytest.mark.parametrize(
    ("values", "bars"),
    [
        ([1.0], 1),
        ([0.0, 0.0], 1),
        ([500.0] * 100, 1),
        ([1e18] * 3, 1),
        ([1e99, 1e99], 1),
        ([1e18, 1e18 + 256.0], 1),
        ([-1e99, 1e99], 6),
        ([1e-300, 3e-300], 6),
        (list(range(1000)), 24),
        (list(range(100_000)), 38),
    ],
)
def test_histogram_holds_all_values(values: list[float], bars: int) -> None:
    chart = histogram("returns", np.array(values, np.float64), marks=[("mean", values[0])], unit="return")
    assert len(drawn(chart, "bar")) == bars
    assert f"{len(values):,} from" in chart.attrib["aria-label"]


def test_the_ends_of_a_long_line_are_drawn_as_they_are() -> None:
    y = np.zeros(10_000)
    y[0], y[-1] = -300.0, 1_000_001.0
    chart = line_chart("return", [Series(name="a", x=np.arange(10_000.0), y=y)], unit="env_steps", colours=[0])
    assert "from -300 to 1,000,001" in chart.attrib["aria-label"]
    (line,) = drawn(chart, "series-1")
    heights = [float(point.split()[1]) for point in re.findall(r"[ML] ([-\d.]+ [-\d.]+)", line)]
    assert heights[-1] == min(heights)
    assert len(heights) <= 400


def test_two_charts_of_a_page_share_no_name() -> None:
    line = Series(name="a", x=np.arange(9.0), y=np.arange(9.0), marks=(np.ones(1), np.ones(1)))
    charts = [line_chart(title, [line], unit="env_steps", colours=[0]) for title in ("return", "entropy")]
    first, second = ({each.attrib["id"] for each in chart.iter() if "id" in each.attrib} for chart in charts)
    assert first
    assert not first & second
