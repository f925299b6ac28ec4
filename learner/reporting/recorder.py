"""Hands metrics rows to the writers and to the progress line.

Works on a thread of its own: a slow disk, or a writer that takes long to start, costs training nothing.
"""

import contextlib
import logging
import queue
import threading
import time
from collections.abc import Callable, Sequence

from daedalus.learner.reporting.metrics import Details, MetricsWriter
from daedalus.learner.reporting.progress import Progress

_QUEUED_ROWS = 256  # rows beyond that are dropped
_RETRY_SECONDS = 10.0  # after a writer refused a row
_CLOSE_SECONDS = 5.0

_logger = logging.getLogger(__name__)

OpenWriter = Callable[[], MetricsWriter]  # opens the files, or raises OSError


class Recorder:
    """Writes rows in the order they come, from construction to `close`."""

    def __init__(self, open_writers: Sequence[OpenWriter], progress: Progress) -> None:
        """`open_writers` are called when the first row comes, and again after a writer failed."""
        self._open_writers, self._progress = open_writers, progress
        self._writers: list[MetricsWriter] = []
        self._refused_at: float | None = None
        self._rows: queue.Queue[tuple[dict[str, float], Details] | None] = queue.Queue(_QUEUED_ROWS)
        self._thread = threading.Thread(target=self._work, name="recorder", daemon=True)
        self._thread.start()

    def record(self, row: dict[str, float], details: Details) -> None:
        """Take a row; never wait."""
        with contextlib.suppress(queue.Full):
            self._rows.put_nowait((row, details))

    def close(self) -> None:
        """Write what is left."""
        with contextlib.suppress(queue.Full):  # a writer hangs: its rows are lost, and the run ends all the same
            self._rows.put(None, timeout=_CLOSE_SECONDS)
        self._thread.join(timeout=_CLOSE_SECONDS)
        self._progress.end()

    def _work(self) -> None:
        while (taken := self._rows.get()) is not None:
            self._progress.show(taken[0])
            if self._refused_at is None or time.monotonic() >= self._refused_at + _RETRY_SECONDS:
                self._write(*taken)
        self._close_writers()

    def _write(self, row: dict[str, float], details: Details) -> None:
        """Write a row. One that a writer refuses is dropped, and the files are opened again for a later one."""
        try:
            if not self._writers:
                for open_writer in self._open_writers:
                    self._writers.append(open_writer())
            for writer in self._writers:
                writer.write(row, details)
        except OSError as error:
            self._close_writers()
            if self._refused_at is None:
                _logger.warning("metrics cannot be written (%s); training goes on", error.strerror)
            self._refused_at = time.monotonic()
            return
        if self._refused_at is not None:
            self._refused_at = None
            _logger.info("metrics are written again")

    def _close_writers(self) -> None:
        for writer in self._writers:
            with contextlib.suppress(OSError):  # what it could not write was logged already
                writer.close()
        self._writers.clear()
