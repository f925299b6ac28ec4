"""Runs as their learners report them, query after query, for a live display."""

import math
import threading
from collections.abc import Callable, Iterator
from contextlib import suppress

from daedalus.gateway.watching.learner_source import LearnerSource
from daedalus.protocol.codec import ProtocolError
from daedalus.protocol.messages import MetricsReport, RunStatus
from daedalus.transport.interface import RefusedError, Transport, TransportError
from daedalus.transport.status_query import survey

_CURVES = ("rating", "episode_return_mean")  # of a run, the first that it has
_MAX_POINTS = 4096  # then every second one is dropped


class WatchedRun:
    """Newest status of a learner, and the curve of its whole run: of ratings or returns."""

    def __init__(self, status: RunStatus) -> None:
        self.status = status
        self.curve: list[float] = []  # from the begin of the run on
        self._column = ""  # whose values it has
        self.next_row = 0  # of the metrics, not seen yet

    @property
    def seconds_left(self) -> float | None:
        """Seconds until the budget is used up, or None if it is not known. A run may reach its target before."""
        left = self.status.env_steps_budget - self.status.env_steps
        rate = self.status.env_steps_per_second
        return max(left, 0) / rate if rate > 0.0 else None

    def add_status(self, status: RunStatus) -> None:
        """Take a newer status of the same learner."""
        self.status = status

    def add_rows(self, report: MetricsReport) -> None:
        """Take further rows of the metrics."""
        if not len(report.numbers):
            return
        self.next_row = int(report.numbers[-1]) + 1
        column = next((name for name in _CURVES if name in report.page.columns), "")
        if column:
            self.curve = self.curve if column == self._column else []
            self._column = column
            values = report.values[:, report.page.columns.index(column)].tolist()
            self.curve += [value for value in values if math.isfinite(value)]
        while len(self.curve) > _MAX_POINTS:
            del self.curve[::2]


MAX_ACTORS = 50  # of each run that are queried; a terminal has no lines for more
_MOST_PAGES = 8  # of the metrics for one look


class RunWatcher:
    """Watcher of the learners that answer at an address."""

    def __init__(self, transport: Transport, run: str) -> None:
        """Construct the watcher. `run` is the name of the run, or `*` for all runs."""
        self._transport, self._run = transport, run
        self._source = LearnerSource(transport, run)
        self._runs: dict[int, WatchedRun] = {}  # by learner epoch

    def look(self) -> list[WatchedRun]:
        """Return the runs whose learners can be read; the others are logged once. Raises TransportError."""
        runs: dict[int, WatchedRun] = {}
        found = survey(self._transport, self._run, max_actors=MAX_ACTORS)
        found.log()
        for status in found.statuses:
            run = runs[status.learner_epoch] = self._runs.get(status.learner_epoch) or WatchedRun(status)
            run.add_status(status)
            with suppress(ProtocolError):  # of another release: without its curve
                self._add_rows(run)
        self._runs = runs
        return sorted(runs.values(), key=lambda run: run.status.run)

    def _add_rows(self, run: WatchedRun) -> None:
        for _ in range(_MOST_PAGES):
            report = self._source.metrics(run.status, run.next_row)
            if report is None or not len(report.numbers):
                break
            run.add_rows(report)


def looks(
    connect: Callable[[], Transport], run: str, stop: threading.Event, seconds: float
) -> Iterator[list[WatchedRun]]:
    """Yield the runs that answer, every few seconds; an empty list while none does. Reconnect if the network fails.

    Args:
      connect: opens the transport. Raises TransportError.
      run: name of the run, or `*` for all runs.
      stop: ends the iteration.
      seconds: from one look to the next.

    Raises RefusedError.
    """
    while not stop.is_set():
        try:
            transport = connect()
        except RefusedError:
            raise
        except TransportError:
            yield []
            stop.wait(seconds)
            continue
        try:
            watcher = RunWatcher(transport, run)
            while not stop.is_set() and (runs := watcher.look()):
                yield runs
                stop.wait(seconds)
        except RefusedError:
            raise
        except TransportError:
            pass  # connect again
        finally:
            transport.close()
        if not stop.is_set():
            yield []
            stop.wait(seconds)
