"""Observes a run on a thread of its own: often while somebody watches, else now and then."""

import logging
import threading
import time
from collections.abc import Callable
from dataclasses import replace

from daedalus.gateway.watching.page_data import Observation, ReadFolder, RunSource
from daedalus.protocol.codec import ProtocolError
from daedalus.protocol.messages import ActorStatus, RunStatus
from daedalus.transport.interface import TransportError

_logger = logging.getLogger(__name__)

WATCHED_SECONDS, UNWATCHED_SECONDS = 1.0, 10.0  # between two observations
MAX_ACTORS = 2000  # that the page shows
_ACTORS_PER_SECOND = 400  # of a large fleet are queried
_MAX_ROWS = 4000  # then the rows are queried anew: the learner has fewer of the same run


class RunMonitor:
    """Observer of one run. `observation` is the newest; any thread may read it."""

    def __init__(
        self,
        source: RunSource,
        on_observation: Callable[[Observation], None],
        ended: Callable[[], str] = lambda: "",
        read_folder: ReadFolder = lambda run: None,
    ) -> None:
        """Construct the monitor.

        Args:
          source: the learner.
          on_observation: called on the monitor's thread.
          ended: returns how the run ended, or an empty string while it goes on.
          read_folder: reads the directory of the run.
        """
        self._source, self._on_observation, self._ended = source, on_observation, ended
        self._read_folder = read_folder
        self._seen = Observation(state="waiting")
        self._watched, self._stop, self._wake = False, threading.Event(), threading.Event()
        self._actors_due = 0.0
        self._thread = threading.Thread(target=self._run, name="monitor", daemon=True)

    def open(self) -> None:
        """Begin to observe."""
        self._thread.start()

    def close(self) -> None:
        """Stop observing. At most about 1 s."""
        self._stop.set()
        self._wake.set()
        if self._thread.is_alive():
            self._thread.join(1.0)

    def watch(self, watched: bool) -> None:
        """Set whether somebody watches. From any thread."""
        if watched and not self._watched:
            self._wake.set()
        self._watched = watched

    def look(self) -> None:
        """Observe now: something has happened. From any thread."""
        self._wake.set()

    def _run(self) -> None:
        while not self._stop.is_set():
            self._wake.clear()
            self._seen = self._with_folder(self._observed())
            self._on_observation(self._seen)
            self._wake.wait(WATCHED_SECONDS if self._watched else UNWATCHED_SECONDS)

    def last_look(self) -> Observation:
        """Return the last observation, with what the run directory has by now. Call it after `close`."""
        return self._with_folder(self._seen, is_last=True)

    def _with_folder(self, seen: Observation, *, is_last: bool = False) -> Observation:
        """Add what the run directory has. It says how the run ended if the learner could not say so any more."""
        if seen.status is None:
            return seen
        folder = self._read_folder(seen.status.run)
        if folder is not None and folder.ends and (seen.state == "lost" or (is_last and seen.state == "running")):
            seen = replace(seen, state="stopped" if folder.stopped else "ended", reason="")
        return replace(seen, folder=folder)

    def _observed(self) -> Observation:
        try:
            wants_all = time.monotonic() >= self._actors_due
            status = self._source.status(MAX_ACTORS if wants_all else 0)
            if status is None:
                return self._without_answer()
            return self._with(status, wants_all)
        except (TransportError, ProtocolError) as error:
            _logger.debug("the learner cannot be observed: %s", error)
            return replace(self._without_answer(), reason=str(error))

    def _without_answer(self) -> Observation:
        reason = self._ended()
        if reason:
            return replace(self._seen, state="ended", reason=reason)
        return replace(self._seen, state="waiting" if self._seen.status is None else "lost", reason="")

    def _with(self, status: RunStatus, has_all: bool) -> Observation:
        seen = self._seen
        if seen.status is not None and seen.status.learner_epoch != status.learner_epoch:
            seen = Observation(generation=seen.generation + 1)
        if has_all or len(status.actors) >= status.fleet_size:
            seen = replace(seen, actors=_unless_equal(seen.actors, status.actors))
            self._actors_due = time.monotonic() + len(status.actors) / _ACTORS_PER_SECOND
        page = self._source.events(status)
        if page is not None and page.events != seen.events:
            seen = replace(seen, events=page.events)
        reason = self._ended()
        seen = replace(seen, state="ended" if reason else "running", reason=reason, status=status)
        return self._with_rows(seen, status)

    def _with_rows(self, seen: Observation, status: RunStatus) -> Observation:
        """Add the rows that have come since."""
        if len(seen.rows) > _MAX_ROWS:
            seen = replace(seen, rows=(), generation=seen.generation + 1)
        rows = list(seen.rows)
        while not self._stop.is_set():
            report = self._source.metrics(status, rows[-1][0] + 1 if rows else 0)
            if report is None or not len(report.numbers) or report.page.learner_epoch != status.learner_epoch:
                break
            names = report.page.columns
            for number, values in zip(report.numbers.tolist(), report.values.tolist(), strict=True):
                row = {name: value for name, value in zip(names, values, strict=True) if value == value}
                rows.append((number, row))
        return seen if len(rows) == len(seen.rows) else replace(seen, rows=tuple(rows))


def _unless_equal(old: tuple[ActorStatus, ...], new: tuple[ActorStatus, ...]) -> tuple[ActorStatus, ...]:
    return old if old == new else new
