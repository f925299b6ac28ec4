"""learner/reporting/trackers/tracking.py: rows reach a tracker in order and once, whatever the tracker does."""

import json
import threading
from collections.abc import Iterator, Mapping
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Any

import pytest
from log_lines import LINES
from processes import LIMIT, until
from recorded_runs import record

from daedalus.learner.reporting import thinning
from daedalus.learner.reporting.csv_writer import CsvWriter
from daedalus.learner.reporting.metrics_rows import Details
from daedalus.learner.reporting.trackers import tracking
from daedalus.learner.reporting.trackers.tracker import TrackedRun
from daedalus.learner.reporting.trackers.tracking import Tracking

TAPE: list[Any] = []


class Tape:
    """Tracker that remembers what it receives, and fails or waits on demand."""

    fails = threading.Event()
    waits = threading.Event()  # while it is set, `write` does not return
    place = "on tape"

    def __init__(self, run: TrackedRun) -> None:
        self.id = run.id or "new"
        TAPE.append(("opened", run.id, run.settings["training"]["seed"]))

    def write(self, row: Mapping[str, float], details: Details) -> None:
        while self.waits.is_set():
            threading.Event().wait(0.01)
        if self.fails.is_set():
            raise ConnectionError("no route\nto host")
        TAPE.append(row["env_steps"] if "evaluation_return_mean" not in row else (row["env_steps"], "evaluated"))

    def summarize(self, summary: Mapping[str, Any]) -> None:
        TAPE.append(("summary", summary.get("solved"), summary.get("evaluation.episodes")))

    def close(self) -> None:
        TAPE.append("closed")


@pytest.fixture(autouse=True)
def quick(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    TAPE.clear()
    Tape.fails.clear()
    Tape.waits.clear()
    monkeypatch.setattr(tracking, "_POLL_SECONDS", 0.01)
    monkeypatch.setattr(tracking, "_RETRY_SECONDS", 0.0)
    yield
    Tape.waits.clear()


@contextmanager
def logged(directory: Path) -> Iterator[None]:
    """Log the run while the block runs, to the end of what it writes."""
    finish = threading.Event()
    thread = threading.Thread(target=Tracking("wandb", directory, Tape, finish).run)
    thread.start()
    try:
        yield
    finally:
        Tape.waits.clear()
        finish.set()
        thread.join(LIMIT)
        assert not thread.is_alive()


def add_rows(directory: Path, *env_steps: int, **values: float) -> None:
    writer = CsvWriter(directory / "metrics.csv")
    for steps in env_steps:
        writer.write({"env_steps": steps, **values}, Details())
    writer.close()


def warnings() -> list[str]:
    return [line for line in LINES if "training continues" in line]


def test_rows_and_summary_are_logged_in_order(tmp_path: Path) -> None:
    directory = record(tmp_path / "run", seed=7, finished=False, evaluation=None)
    with logged(directory):
        until(lambda: 3000 in TAPE)
        add_rows(directory, 4000)
        until(lambda: 4000 in TAPE)
        (directory / "summary.json").write_text(json.dumps({"solved": True, "evaluation": {"episodes": 100, "x": []}}))
    assert TAPE == [("opened", "", 7), 1000, 2000, 3000, 4000, ("summary", True, 100), "closed"]


def test_the_tracker_is_not_opened_before_the_first_row(tmp_path: Path) -> None:
    directory = record(tmp_path / "run", finished=False, evaluation=None)
    rows = (directory / "metrics.csv").read_bytes()
    (directory / "metrics.csv").unlink()
    with logged(directory):
        threading.Event().wait(0.1)
        assert TAPE == []
        (directory / "metrics.csv").write_bytes(rows)
        until(lambda: 3000 in TAPE)


def test_a_run_that_ends_before_its_first_row_is_not_logged(tmp_path: Path) -> None:
    directory = record(tmp_path / "run", finished=False, evaluation=None)
    (directory / "metrics.csv").unlink()
    files = set(directory.iterdir())
    with logged(directory):
        pass
    assert TAPE == []
    assert set(directory.iterdir()) == files


def test_a_resumed_run_continues_under_its_id_and_makes_no_step_twice(tmp_path: Path) -> None:
    directory = record(tmp_path / "run", finished=False, evaluation=None)
    with logged(directory):
        pass
    TAPE.clear()
    add_rows(directory, 2500)  # from a checkpoint before the last row
    add_rows(directory, 2600, evaluation_return_mean=12.0, evaluation_env_steps=2550)
    add_rows(directory, 3500, 4000)
    with logged(directory):
        pass
    assert TAPE == [("opened", "new", 1), (3500, "evaluated"), 4000, ("summary", None, None), "closed"]


def test_a_failing_tracker_gets_all_rows_later_and_the_user_one_warning(tmp_path: Path) -> None:
    Tape.fails.set()
    directory = record(tmp_path / "run", finished=False, evaluation=None)
    with logged(directory):
        until(lambda: TAPE.count("closed") >= 3)
        Tape.fails.clear()
        until(lambda: 3000 in TAPE)
    assert [entry for entry in TAPE if isinstance(entry, float)] == [1000, 2000, 3000]
    assert warnings() == [
        "wandb: ConnectionError: no route to host; it is tried again every 0 s; "
        "training continues, and its metrics are in metrics.csv"
    ]


def test_a_tracker_that_does_not_answer_is_reported_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tracking, "_SLOW_SECONDS", 0.05)
    Tape.waits.set()
    directory = record(tmp_path / "run", finished=False, evaluation=None)
    with logged(directory):
        until(warnings)
        threading.Event().wait(0.2)
    assert warnings() == ["wandb: no answer for 0 s; training continues, and its metrics are in metrics.csv"]
    assert [entry for entry in TAPE if isinstance(entry, float)] == [1000, 2000, 3000]


def test_the_state_after_a_failure_has_the_rows_that_were_logged(tmp_path: Path) -> None:
    directory = record(tmp_path / "run", finished=False, evaluation=None)
    with logged(directory):
        until(lambda: 3000 in TAPE)
        Tape.fails.set()
        add_rows(directory, 4000)
        until(warnings)
    state = {"id": "new", "env_steps": 3000, "wall_seconds": 180.0, "evaluation_env_steps": -1}
    assert json.loads((directory / "tracker-wandb.json").read_text()) == state


def test_a_damaged_state_begins_anew(tmp_path: Path) -> None:
    directory = record(tmp_path / "run", finished=False, evaluation=None)
    (directory / "tracker-wandb.json").write_text('{"id": 5, "env_steps": "many"}')
    with logged(directory):
        pass
    assert TAPE[:2] == [("opened", "", 1), 1000]


def test_every_row_is_logged_once_while_old_rows_are_merged(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(thinning, "MAX_BYTES", 4000)
    directory = record(tmp_path / "run", finished=False, evaluation=None)
    with closing(CsvWriter(directory / "metrics.csv")) as writer, logged(directory):
        for step in range(4000, 104_000, 1000):
            evaluation = {"evaluation_return_mean": 1.0, "evaluation_env_steps": step} if step % 9000 == 0 else {}
            writer.write({"env_steps": step, "wall_seconds": step / 10, **evaluation}, Details())
            if step % 10_000 == 0:  # fewer rows than the newest that are never merged
                until(lambda: {step, (step, "evaluated")} & set(TAPE))  # noqa: B023
    logged_steps = [each[0] if isinstance(each, tuple) else each for each in TAPE[1:-2]]
    assert logged_steps == list(range(1000, 104_000, 1000))
    evaluated = [each[0] for each in TAPE if isinstance(each, tuple) and each[1] == "evaluated"]
    assert evaluated == list(range(9000, 104_000, 9000))
    assert len((directory / "metrics.csv").read_text().splitlines()) < 90  # the file was thinned meanwhile
