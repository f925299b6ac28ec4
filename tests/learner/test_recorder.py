"""learner/reporting/recorder.py: rows are written in order, and a disk error loses only its rows."""

import csv
import errno
import io
import threading
from collections.abc import Mapping
from pathlib import Path

import pytest
from log_lines import LINES
from processes import until

from daedalus.learner.reporting import recorder
from daedalus.learner.reporting.csv_writer import CsvWriter
from daedalus.learner.reporting.metrics_rows import Details
from daedalus.learner.reporting.progress import Progress
from daedalus.learner.reporting.recorder import Recorder

ROW = {
    "wall_seconds": 1.0,
    "env_steps_per_second": 1.0,
    "updates_per_second": 1.0,
    "policy_lag_mean": 0.0,
    "actors": 1,
}


def row(env_steps: int) -> dict[str, float]:
    return {**ROW, "env_steps": env_steps}


def env_steps(directory: Path) -> list[str]:
    with open(directory / "metrics.csv", newline="") as file:
        return [line["env_steps"] for line in csv.DictReader(file)]


def test_every_writer_gets_every_row_and_is_closed() -> None:
    tape: list[object] = []

    class Tape:
        def __init__(self, name: str) -> None:
            self.name = name

        def write(self, row: Mapping[str, float], details: Details) -> None:
            tape.append((self.name, row["env_steps"]))

        def close(self) -> None:
            tape.append((self.name, "closed"))

    recording = Recorder([lambda: Tape("one"), lambda: Tape("two")], Progress(io.StringIO(), 100))
    recording.record(row(7), Details())
    recording.close()
    assert tape == [("one", 7), ("two", 7), ("one", "closed"), ("two", "closed")]


def test_rows_are_written_in_order(tmp_path: Path) -> None:
    recording = Recorder([lambda: CsvWriter(tmp_path / "metrics.csv")], Progress(io.StringIO(), 100))
    for number in range(5):
        recording.record(row(number), Details())
    recording.close()
    assert env_steps(tmp_path) == ["0", "1", "2", "3", "4"]


def test_full_disk_logs_one_warning_and_writing_resumes_when_there_is_space(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    full = threading.Event()
    full.set()

    class OnThisDisk(CsvWriter):
        def write(self, row: Mapping[str, float], details: Details) -> None:
            if full.is_set():
                raise OSError(errno.ENOSPC, "No space left on device")
            super().write(row, details)

    monkeypatch.setattr(recorder, "_RETRY_SECONDS", 0.0)
    recording = Recorder([lambda: OnThisDisk(tmp_path / "metrics.csv")], Progress(io.StringIO(), 100))
    recording.record(row(1), Details())
    recording.record(row(2), Details())
    recording.record(row(3), Details())
    until(lambda: any("metrics not written" in line for line in LINES))
    until(lambda: recording._rows.empty())
    full.clear()
    recording.record(row(4), Details())
    recording.record(row(5), Details())
    recording.close()
    logged = [line for line in LINES if "metrics" in line]
    assert logged == [
        "metrics not written: No space left on device; training continues, and writing is retried every 0 s",
        "metrics are written again",
    ]
    assert env_steps(tmp_path)[-2:] == ["4", "5"]


def test_rows_are_written_again_after_the_directory_was_moved(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(recorder, "_RETRY_SECONDS", 0.0)
    directory = tmp_path / "run"
    directory.mkdir()
    recording = Recorder([lambda: CsvWriter(directory / "metrics.csv")], Progress(io.StringIO(), 100))
    recording.record(row(1), Details())
    until(lambda: (directory / "metrics.csv").exists() and env_steps(directory) == ["1"])
    directory.rename(tmp_path / "moved")
    recording.record(row(2), Details())
    until(lambda: any("metrics not written: No such file or directory" in line for line in LINES))
    directory.mkdir()
    recording.record(row(3), Details())
    recording.close()
    assert env_steps(directory) == ["3"]


def test_partly_written_line_is_removed_when_the_disk_is_full(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    writer = CsvWriter(tmp_path / "metrics.csv")
    writer.write(row(1), Details())
    whole = (tmp_path / "metrics.csv").read_bytes()

    class Filling:
        """File on a disk with space for three more bytes."""

        def __init__(self, file: io.FileIO) -> None:
            self._file, self._space = file, 3

        def write(self, data: bytes) -> int:
            if not self._space:
                raise OSError(errno.ENOSPC, "No space left on device")
            written, self._space = self._space, 0
            return self._file.write(data[:written])

        def __getattr__(self, name: str) -> object:
            return getattr(self._file, name)

    monkeypatch.setattr(writer, "_file", Filling(writer._file))
    with pytest.raises(OSError, match="No space left"):
        writer.write(row(2), Details())
    assert (tmp_path / "metrics.csv").read_bytes() == whole
    writer.close()
