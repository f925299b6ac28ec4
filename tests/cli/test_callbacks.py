"""launch/callbacks.py and learner/reporting/user_metrics.py: rows to a callback, and its metrics to the learner."""

import json
import os
import subprocess
import sys
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import pytest

from daedalus.launch.callbacks import Callback, CallbackObserver, TrainingRun, observed
from daedalus.learner.reporting.metrics_rows import Details
from daedalus.learner.reporting.user_metrics import MOST_METRICS, RowsWriter, UserMetrics


class Recording(Callback):
    """Callback that records its calls."""

    def __init__(self) -> None:
        self.rows: list[Mapping[str, float]] = []

    def on_metrics(self, run: TrainingRun, row: Mapping[str, float]) -> None:
        self.rows.append(row)
        run.log({"seen": len(self.rows)})
        if row["env_steps"] >= 300:
            run.stop("enough")


@pytest.fixture
def learner() -> Iterator[subprocess.Popen[bytes]]:
    """Process that repeats the first line of its standard input."""
    program = "import sys; print(sys.stdin.readline(), end='', flush=True)"
    process = subprocess.Popen([sys.executable, "-c", program], stdin=subprocess.PIPE, stdout=subprocess.PIPE)
    yield process
    process.kill()
    process.communicate()


def test_rows_reach_the_callback_and_its_metrics_the_learner(tmp_path: Path, learner: subprocess.Popen[bytes]) -> None:
    callback = Recording()
    with observed(callback, tmp_path) as (observer, run):
        writer = RowsWriter(observer.descriptors[0])
        assert not observer.poll(learner)
        writer.write({"env_steps": 100, "entropy": 0.5}, Details())
        writer.write({"env_steps": 200}, Details())
        assert not observer.poll(learner)
        assert callback.rows == [{"env_steps": 100, "entropy": 0.5}, {"env_steps": 200}]
        metrics = UserMetrics()
        assert learner.stdout is not None
        metrics.add_line(learner.stdout.readline())
        assert metrics.take() == {"user/seen": 2.0}
        writer.write({"env_steps": 300}, Details())
        writer.write({"env_steps": 400}, Details())
        assert observer.poll(learner)
    assert len(callback.rows) == 3  # none after the callback has ended training
    assert run.stop_reason == "enough"


def test_a_callback_that_does_not_return_does_not_hold_the_learner(tmp_path: Path) -> None:
    observer = CallbackObserver(Callback(), TrainingRun(tmp_path))
    writer = RowsWriter(observer.descriptors[0])
    for number in range(10_000):
        writer.write({"env_steps": number}, Details())
    observer.close()


def test_a_row_that_was_cut_off_is_left_out(tmp_path: Path, learner: subprocess.Popen[bytes]) -> None:
    callback = Recording()
    observer = CallbackObserver(callback, TrainingRun(tmp_path))
    os.write(observer.descriptors[0], b'{"env_steps": 1}\n{"env_st')
    observer.poll(learner)
    os.write(observer.descriptors[0], b'{"env_steps": 2}\n{"env_steps": 3}\n')
    observer.poll(learner)
    assert callback.rows == [{"env_steps": 1}, {"env_steps": 3}]
    observer.close()


@pytest.mark.parametrize("metrics", [{"a b": 1.0}, {"nan": float("nan")}, {"": 1.0}, {"text": "1"}, {1: 1.0}])
def test_a_metric_that_cannot_be_written_is_refused(tmp_path: Path, metrics: dict[Any, Any]) -> None:
    with pytest.raises(ValueError, match="use a finite number"):
        TrainingRun(tmp_path).log(metrics)


def test_more_metrics_than_a_row_takes_are_refused(tmp_path: Path) -> None:
    run = TrainingRun(tmp_path)
    run.log({f"m{number}": 1.0 for number in range(MOST_METRICS)})
    run.log({"m0": 2.0})
    with pytest.raises(ValueError, match="a row has at most 64 metrics of yours: log fewer names"):
        run.log({"m1": 5.0, "another": 1.0})
    assert run.take_metrics() == {f"m{number}": 1.0 + (number == 0) for number in range(MOST_METRICS)}
    run.log({"another": 1.0})


def test_the_learner_ignores_what_is_no_metric() -> None:
    metrics = UserMetrics()
    for line in (b"", b"\xff", b"[1]", b'{"a": "x", "b/c": 1, "d": NaN, "e": [1], "good": 2}', b"7"):
        metrics.add_line(line)
    assert metrics.take() == {"user/good": 2.0}
    assert metrics.take() == {}
    metrics.add_line(json.dumps({f"m{number}": number for number in range(1000)}).encode())
    assert len(metrics.take()) == 64
