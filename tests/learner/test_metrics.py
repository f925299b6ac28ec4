"""learner/reporting/metrics.py: rows that can be read again by those who read them."""

import csv
from pathlib import Path

import numpy as np
import pytest
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from daedalus.learner.reporting.metrics import COLUMNS, CsvWriter, Details, MetricsWriters, TensorBoardWriter
from daedalus.learner.training.update_metrics import METRICS

NONE = Details()


def read(path: Path) -> list[dict[str, str]]:
    with open(path, newline="") as file:
        return list(csv.DictReader(file))


def test_csv_has_a_header_and_a_line_for_each_row_with_blanks_for_the_unknown(tmp_path: Path) -> None:
    writer = CsvWriter(tmp_path / "metrics.csv")
    writer.write({"env_steps": 12_345_678, "wall_seconds": 1.23456789, "policy_loss": -1e-9}, NONE)
    (row,) = read(tmp_path / "metrics.csv")  # there before the writer is closed
    writer.close()
    assert tuple(row) == COLUMNS
    known = {name: text for name, text in row.items() if text}
    assert known == {"env_steps": "12345678", "wall_seconds": "1.23457", "policy_loss": "-1e-09"}


def test_csv_goes_on_after_a_resume_without_a_second_header(tmp_path: Path) -> None:
    path = tmp_path / "metrics.csv"
    for env_steps in (1, 2):
        writer = CsvWriter(path)
        writer.write({"env_steps": env_steps}, NONE)
        writer.close()
    assert [row["env_steps"] for row in read(path)] == ["1", "2"]


def test_csv_goes_on_in_the_columns_that_another_release_began_with(tmp_path: Path) -> None:
    path = tmp_path / "metrics.csv"
    path.write_text("wall_seconds,policy_loss,env_steps,no_longer_measured\r\n0.5,0.25,10,7\r\n")
    writer = CsvWriter(path)
    writer.write({"env_steps": 20, "clipped_fraction": 0.1, "policy_loss": -1.5, "wall_seconds": 1.5}, NONE)
    writer.close()
    names = ("wall_seconds", "policy_loss", "env_steps", "no_longer_measured")
    assert read(path) == [
        dict(zip(names, ("0.5", "0.25", "10", "7"), strict=True)),
        dict(zip(names, ("1.5", "-1.5", "20", ""), strict=True)),
    ]


def test_csv_gives_a_file_that_is_empty_its_header(tmp_path: Path) -> None:
    path = tmp_path / "metrics.csv"
    path.touch()
    CsvWriter(path).close()
    assert path.read_text().strip() == ",".join(COLUMNS)


def test_tensorboard_reads_the_rows_against_env_steps(tmp_path: Path) -> None:
    writer = TensorBoardWriter(tmp_path)
    writer.write({"env_steps": 100, "policy_loss": 0.5, "updates": 3}, NONE)
    writer.write({"env_steps": 250, "policy_loss": -1.5}, NONE)
    writer.close()
    events = EventAccumulator(str(tmp_path))
    events.Reload()
    assert sorted(events.Tags()["scalars"]) == ["policy_loss", "updates"]
    assert [(scalar.step, scalar.value) for scalar in events.Scalars("policy_loss")] == [(100, 0.5), (250, -1.5)]
    assert [(scalar.step, scalar.value) for scalar in events.Scalars("updates")] == [(100, 3.0)]


def test_tensorboard_shows_distributions_and_what_the_network_sees(tmp_path: Path) -> None:
    picture = np.arange(6 * 8 * 3, dtype=np.uint8).reshape(6, 8, 3)
    details = Details(returns=[1.0, 1.0, 5.0], lengths=[3, 4, 4], action_counts=[2, 0, 5], picture=picture)
    writer = TensorBoardWriter(tmp_path)
    writer.write({"env_steps": 100}, details)
    writer.write({"env_steps": 200}, Details(action_counts=[0, 0, 0]))  # nothing new
    writer.close()
    events = EventAccumulator(str(tmp_path))
    events.Reload()
    assert sorted(events.Tags()["histograms"]) == ["action", "episode_length", "episode_return"]
    (returns,) = events.Histograms("episode_return")
    assert (returns.step, returns.histogram_value.num, returns.histogram_value.sum) == (100, 3.0, 7.0)
    assert (returns.histogram_value.min, returns.histogram_value.max) == (1.0, 5.0)
    assert events.Histograms("action")[0].histogram_value.bucket == [2.0, 0.0, 5.0]
    (image,) = events.Images("what_the_network_sees")
    assert (image.step, image.width, image.height) == (100, 8, 6)


def test_several_writers_get_all_that_one_gets() -> None:
    tape: list[object] = []

    class Tape:
        def __init__(self, name: str) -> None:
            self.name = name

        def write(self, row: object, details: object) -> None:
            tape.append((self.name, row, details))

        def close(self) -> None:
            tape.append((self.name, "closed"))

    writers = MetricsWriters([Tape("one"), Tape("two")])
    writers.write({"updates": 1}, NONE)
    writers.close()
    assert tape == [("one", {"updates": 1}, NONE), ("two", {"updates": 1}, NONE), ("one", "closed"), ("two", "closed")]


def test_what_the_learner_measures_has_its_columns() -> None:
    assert set(METRICS) <= set(COLUMNS)
    assert len(set(COLUMNS)) == len(COLUMNS)


def test_a_file_that_cannot_be_opened_is_an_os_error(tmp_path: Path) -> None:
    with pytest.raises(OSError, match="Is a directory"):
        CsvWriter(tmp_path)
