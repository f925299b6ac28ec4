"""cli/reports/charts.py: histograms of any finite returns."""

import re

import numpy as np
import pytest

from daedalus.cli.reports.charts import histogram


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
