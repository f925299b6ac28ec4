"""Callbacks of `daedalus.train`: a program's own metrics and its own rule to stop, in its own process."""

import json
import math
import os
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path

from daedalus.launch.local_run import RunObserver
from daedalus.launch.supervision import Child
from daedalus.learner.reporting.user_metrics import MOST_METRICS
from daedalus.policy.user_code import Surroundings
from daedalus.protocol.keys import is_name

_READ_BYTES = 1 << 16


class TrainingRun:
    """The run of a callback: what it may do with the run."""

    def __init__(self, directory: Path) -> None:
        self.directory = directory
        """The run directory. `daedalus.load_policy(run.directory)` loads the best policy that was evaluated, or else
        the best by its training episodes, or else the newest; it raises NoPolicyError before the first checkpoint."""
        self.stop_reason: str | None = None
        """The reason given to `stop`, or None."""
        self._metrics: dict[str, float] = {}

    def stop(self, reason: str) -> None:
        """End training. The learner saves a checkpoint; then the best policy is evaluated as after the whole budget."""
        self.stop_reason = self.stop_reason or reason

    def log(self, metrics: Mapping[str, float]) -> None:
        """Add metrics of your own to the next row of metrics.csv and TensorBoard, as `user/NAME`.

        Args:
          metrics: finite numbers, by names of 1 to 64 letters, digits, '.', '_' or '-'.

        Raises ValueError for another name or number, or for more than 64 names in one call of a method.
        """
        if len(self._metrics.keys() | metrics.keys()) > MOST_METRICS:
            raise ValueError(f"a row has at most {MOST_METRICS} metrics of yours: log fewer names")
        for name, value in metrics.items():
            if not (isinstance(name, str) and is_name(name)) or not _is_finite(value):
                raise ValueError(f"metric {name!r} is {value!r}: use a finite number, and letters, digits, . _ or -")
            self._metrics[name] = float(value)

    def take_metrics(self) -> dict[str, float]:
        """Return the metrics that were not sent to the learner yet."""
        metrics, self._metrics = self._metrics, {}
        return metrics


def _is_finite(value: object) -> bool:
    """Return whether a value of any type is a finite number."""
    try:
        return math.isfinite(value)  # pyright: ignore[reportArgumentType]  # it raises for other types
    except (TypeError, ValueError):
        return False


class Callback:
    """Base class of a callback: override what you need.

    `daedalus.train` calls the methods in its own process and thread, between two looks at the processes of the run.
    Training does not wait for them. An exception in a method ends the run with a checkpoint, and `daedalus.train`
    raises it. A method that changes the working directory does so for itself: it is changed back afterwards.
    """

    def on_start(self, run: TrainingRun) -> None:
        """Called before the processes start."""

    def on_metrics(self, run: TrainingRun, row: Mapping[str, float]) -> None:
        """Called with each row of metrics, every `service.log_seconds`.

        Args:
          run: the run, to stop it or to log metrics of your own.
          row: values by the names of the columns of metrics.csv; columns without a value yet are absent. Rows are left
            out while an earlier call takes many seconds.
        """

    def on_end(self, run: TrainingRun) -> None:
        """Called when training has ended in any way, before the evaluation."""


class CallbackObserver(RunObserver):
    """Link between a callback and the learner process: rows come through a pipe, metrics go to its standard input."""

    def __init__(self, callback: Callback, run: TrainingRun) -> None:
        self._callback, self._run = callback, run
        self._rest = b""
        self._reading, self._writing = os.pipe()
        for descriptor in (self._reading, self._writing):  # neither side ever waits for the other
            os.set_blocking(descriptor, False)

    @property
    def descriptors(self) -> tuple[int, ...]:
        """See RunObserver."""
        return (self._writing,)

    @property
    def learner_options(self) -> list[str]:
        """See RunObserver."""
        return ["--rows-to", str(self._writing)]

    def begin(self, address: str) -> None:
        """See RunObserver."""
        with Surroundings():
            self._callback.on_start(self._run)

    def end(self) -> None:
        """See RunObserver."""
        with Surroundings():
            self._callback.on_end(self._run)

    def poll(self, learner: Child) -> bool:
        """See RunObserver. Pass new rows to the callback, and its metrics to the learner."""
        for line in self._lines():
            try:
                row = json.loads(line)
            except ValueError:  # cut off when the pipe was full
                continue
            with Surroundings():
                self._callback.on_metrics(self._run, row)
            if self._run.stop_reason is not None:
                break
        metrics = self._run.take_metrics()
        if metrics and learner.stdin is not None:
            with suppress(OSError):  # the learner has ended, or does not read
                os.set_blocking(learner.stdin.fileno(), False)
                os.write(learner.stdin.fileno(), json.dumps(metrics).encode() + b"\n")
        return self._run.stop_reason is not None

    def _lines(self) -> list[bytes]:
        with suppress(BlockingIOError):
            while data := os.read(self._reading, _READ_BYTES):
                self._rest += data
        *lines, self._rest = self._rest.split(b"\n")
        return lines

    def close(self) -> None:
        """Close the pipe."""
        os.close(self._reading)
        os.close(self._writing)


@contextmanager
def observed(callback: Callback | None, directory: Path) -> Iterator[tuple[RunObserver, TrainingRun]]:
    """Return an observer for a callback, or one that does nothing, and the run that the callback controls."""
    run = TrainingRun(directory)
    if callback is None:
        yield RunObserver(), run
        return
    observer = CallbackObserver(callback, run)
    try:
        yield observer, run
    finally:
        observer.close()
