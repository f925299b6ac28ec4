"""learner/reporting/metrics_rows.py: the metrics of a run, bounded, and read from its file."""

from pathlib import Path

import numpy as np
import pytest

from daedalus.learner.reporting import thinning
from daedalus.learner.reporting.csv_writer import CsvWriter
from daedalus.learner.reporting.metrics_rows import Details, read_rows
from daedalus.learner.reporting.thinning import MetricsHistory
from daedalus.protocol.codec import decode, encode
from daedalus.protocol.limits import METRICS_LIMITS
from daedalus.protocol.messages import MAX_PAGE_VALUES, MetricsReport


def all_pages(history: MetricsHistory) -> list[MetricsReport]:
    pages, first = [], 0
    while len((page := history.page("r", 1, first)).numbers):
        pages.append(page)
        first = int(page.numbers[-1]) + 1
    return pages


def column(history: MetricsHistory, name: str) -> list[float]:
    found = []
    for page in all_pages(history):
        names = page.page.columns
        found += page.values[:, names.index(name)].tolist() if name in names else [np.nan] * len(page.numbers)
    return found


def test_rows_have_a_value_for_each_column_that_any_of_them_has() -> None:
    history = MetricsHistory()
    history.add({"env_steps": 10, "user/height": 2.0})
    history.add({"env_steps": 20, "entropy": 0.5})
    page = history.page("r", 7, 0)
    assert (page.page.run, page.page.learner_epoch) == ("r", 7)
    assert page.page.columns == ("env_steps", "entropy", "user/height")
    np.testing.assert_array_equal(page.values, [[10, np.nan, 2], [20, 0.5, np.nan]])
    assert history.page("r", 7, 1).numbers.tolist() == [1]
    assert history.page("r", 7, 2).values.shape == (0, 0)


def test_a_long_run_is_thinned_over_its_whole_length_and_keeps_the_newest_row(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(thinning, "MAX_ROWS", 8)
    history, steps = MetricsHistory(), list[float]()
    for step in range(1000):
        history.add({"env_steps": step})
        steps = column(history, "env_steps")
        assert len(steps) <= 8
        assert (steps[0], steps[-1]) == (0, step)
    gaps = np.diff(steps[:-1])
    assert set(gaps) == {256}


def test_an_evaluation_survives_the_row_that_it_came_in(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(thinning, "MAX_ROWS", 4)
    history = MetricsHistory()
    for step in range(33):
        evaluation = {"evaluation_return_mean": float(step), "evaluation_env_steps": step} if step % 16 == 3 else {}
        history.add({"env_steps": step, **evaluation})
    assert [mean for mean in column(history, "evaluation_return_mean") if not np.isnan(mean)] == [3.0, 19.0]


def test_rows_that_a_resumed_run_has_undone_are_removed() -> None:
    history = MetricsHistory()
    for step in (10, 20, 30, 15, 25):
        history.add({"env_steps": step})
    assert column(history, "env_steps") == [10, 15, 25]


def test_pages_are_bounded() -> None:
    history = MetricsHistory()
    for step in range(1900):
        history.add({"env_steps": step, **{f"user/{number}": 1.0 for number in range(79)}})
    pages = all_pages(history)
    assert len(pages) > 1
    assert all(page.values.size <= MAX_PAGE_VALUES for page in pages)
    assert column(history, "env_steps") == list(range(1900))


def test_a_page_can_be_sent_however_many_metrics_a_program_names() -> None:
    history = MetricsHistory()
    for step in range(500):
        history.add({"env_steps": step, **{f"user/{10 * step + number:0>64}": 1.0 for number in range(10)}})
    report = decode(encode(history.page("r", 1, 0)), METRICS_LIMITS)
    assert isinstance(report, MetricsReport)
    assert report.page.columns[:2] == ("env_steps", f"user/{0:0>64}")


def test_rows_are_read_as_they_were_written(tmp_path: Path) -> None:
    path = tmp_path / "metrics.csv"
    writer = CsvWriter(path)
    rows = [{"env_steps": 10, "entropy": 0.5}, {"env_steps": 20, "env/lives": 3.0}]
    for row in rows:
        writer.write(row, Details())
    writer.close()
    assert list(read_rows(path)) == rows


def test_damaged_lines_and_values_are_left_out(tmp_path: Path) -> None:
    path = tmp_path / "metrics.csv"
    path.write_bytes(b"env_steps,entropy\n1,nan\nx,2\n\n2,abc\n3,4,5\n\xff\xfe,1\n5")
    assert list(read_rows(path)) == [
        {"env_steps": 1},
        {"env_steps": 2},
        {"env_steps": 3, "entropy": 4},
        {"env_steps": 5},
    ]


def test_another_file_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "metrics.csv"
    path.write_text("a,b\n1,2\n")
    with pytest.raises(ValueError, match="not the metrics of a run"):
        list(read_rows(path))


def test_as_many_columns_are_read_as_are_shown(tmp_path: Path) -> None:
    path = tmp_path / "metrics.csv"
    for number in (1024, 1025):
        row = {"env_steps": 1.0, **{f"user/{index}": 1.0 for index in range(number - 1)}}
        path.write_text(f"{','.join(row)}\n{','.join(map(str, row.values()))}\n")
        if number == 1024:
            assert list(read_rows(path)) == [row]
            history = MetricsHistory()
            history.add(row)
            assert history.page("r", 1, 0).values.shape == (1, 1024)
    with pytest.raises(ValueError, match=r"metrics\.csv has 1,025 columns, and at most 1,024 are read: log fewer"):
        list(read_rows(path))
