"""learner/metrics.py: rows that can be read again by those who read them."""

import csv
from pathlib import Path

import pytest
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from learner.learner import METRICS
from learner.metrics import COLUMNS, CsvWriter, MetricsWriters, NullWriter, TensorBoardWriter


def read(path: Path) -> list[dict[str, str]]:
    with open(path, newline="") as file:
        return list(csv.DictReader(file))


def test_csv_has_a_header_and_a_line_for_each_row_with_blanks_for_the_unknown(tmp_path: Path) -> None:
    writer = CsvWriter(tmp_path / "metrics.csv")
    writer.write({"env_steps": 12_345_678, "wall_seconds": 1.23456789, "policy_loss": -1e-9})
    (row,) = read(tmp_path / "metrics.csv")  # there before the writer is closed
    writer.close()
    assert tuple(row) == COLUMNS
    known = {name: text for name, text in row.items() if text}
    assert known == {"env_steps": "12345678", "wall_seconds": "1.23457", "policy_loss": "-1e-09"}


def test_csv_goes_on_after_a_resume_without_a_second_header(tmp_path: Path) -> None:
    path = tmp_path / "metrics.csv"
    for env_steps in (1, 2):
        writer = CsvWriter(path)
        writer.write({"env_steps": env_steps})
        writer.close()
    assert [row["env_steps"] for row in read(path)] == ["1", "2"]


def test_csv_gives_a_file_that_is_empty_its_header(tmp_path: Path) -> None:
    path = tmp_path / "metrics.csv"
    path.touch()
    CsvWriter(path).close()
    assert path.read_text().strip() == ",".join(COLUMNS)


def test_tensorboard_reads_the_rows_against_env_steps(tmp_path: Path) -> None:
    writer = TensorBoardWriter(tmp_path)
    writer.write({"env_steps": 100, "policy_loss": 0.5, "updates": 3})
    writer.write({"env_steps": 250, "policy_loss": -1.5})
    writer.close()
    events = EventAccumulator(str(tmp_path))
    events.Reload()
    assert sorted(events.Tags()["scalars"]) == ["policy_loss", "updates"]
    assert [(scalar.step, scalar.value) for scalar in events.Scalars("policy_loss")] == [(100, 0.5), (250, -1.5)]
    assert [(scalar.step, scalar.value) for scalar in events.Scalars("updates")] == [(100, 3.0)]


def test_several_writers_get_all_that_one_gets() -> None:
    tape: list[object] = []

    class Tape:
        def __init__(self, name: str) -> None:
            self.name = name

        def write(self, row: object) -> None:
            tape.append((self.name, row))

        def close(self) -> None:
            tape.append((self.name, "closed"))

    writers = MetricsWriters([Tape("one"), NullWriter(), Tape("two")])
    writers.write({"updates": 1})
    writers.close()
    assert tape == [("one", {"updates": 1}), ("two", {"updates": 1}), ("one", "closed"), ("two", "closed")]


def test_what_the_learner_measures_has_its_columns() -> None:
    assert set(METRICS) <= set(COLUMNS)
    assert len(set(COLUMNS)) == len(COLUMNS)


def test_a_file_that_cannot_be_opened_is_an_os_error(tmp_path: Path) -> None:
    with pytest.raises(OSError, match="Is a directory"):
        CsvWriter(tmp_path)
