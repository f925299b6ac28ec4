"""Recording of metrics rows with the writers and the progress line, and of the events.

The recorder has its own thread, so a slow disk or a slow start of a writer does not delay training.
"""

import contextlib
import logging
import queue
import threading
import time
from collections.abc import Callable, Sequence

from daedalus.learner.reporting.metrics_rows import Details, MetricsWriter
from daedalus.learner.reporting.progress import Progress
from daedalus.learner.run.process_resources import reserved_descriptors

_QUEUED_ROWS = 256  # further rows are dropped
_RETRY_SECONDS = 10.0  # after a writer failed
_CLOSE_SECONDS = 5.0

_logger = logging.getLogger(__name__)

OpenWriter = Callable[[], MetricsWriter]  # opens the files; raises OSError


class Recorder:
    """Recorder of metrics rows, in order, from construction to `close`."""

    def __init__(
        self,
        open_writers: Sequence[OpenWriter],
        progress: Progress,
        write_events: Callable[[], None] = lambda: None,
    ) -> None:
        """Construct the recorder and start its thread.

        Args:
          open_writers: called at the first row, and again after a writer failed.
          progress: shows each row.
          write_events: called after each row; it raises no OSError.
        """
        self.busy_since: float | None = None  # since when a row is being written, if one is; on the monotonic clock
        self._dropped = 0  # rows, since the last that was queued
        self._write_events = write_events
        self._open_writers, self._progress = open_writers, progress
        self._writers: list[MetricsWriter] = []
        self._failed_at: float | None = None
        self._rows: queue.Queue[tuple[dict[str, float], Details] | None] = queue.Queue(_QUEUED_ROWS)
        self._thread = threading.Thread(target=self._work, name="recorder", daemon=True)
        self._thread.start()

    def record(self, row: dict[str, float], details: Details) -> None:
        """Queue a row. Does not block; drops the row if the queue is full."""
        try:
            self._rows.put_nowait((row, details))
        except queue.Full:
            self._dropped += 1
            return
        if self._dropped:
            _logger.warning("%d rows of metrics are missing: the disk was slow", self._dropped)
            self._dropped = 0

    def close(self) -> None:
        """Write the queued rows, and close the writers. If a writer hangs, its rows are lost, but the run must end."""
        began = time.monotonic()
        with contextlib.suppress(queue.Full):
            self._rows.put(None, timeout=_CLOSE_SECONDS)
        self._thread.join(timeout=max(began + _CLOSE_SECONDS - time.monotonic(), 0.0))
        if self._thread.is_alive():
            lost = self._rows.qsize() + self._dropped
            _logger.warning("metrics not written: the last %d rows are lost: the disk is slow", lost)
        self._progress.end()

    def _work(self) -> None:
        while (taken := self._rows.get()) is not None:
            self._progress.show(taken[0], taken[1].waits_for)
            self.busy_since = time.monotonic()
            with reserved_descriptors():
                if self._failed_at is None or time.monotonic() >= self._failed_at + _RETRY_SECONDS:
                    self._write(*taken)
                self._write_events()
            self.busy_since = None
        self._close_writers()

    def _write(self, row: dict[str, float], details: Details) -> None:
        """Write a row. If a writer fails, drop the row and reopen the files for a later row."""
        try:
            if not self._writers:
                for open_writer in self._open_writers:
                    self._writers.append(open_writer())
            for writer in self._writers:
                writer.write(row, details)
        except OSError as error:
            self._close_writers()
            if self._failed_at is None:
                _logger.warning(
                    "metrics not written: %s; training continues, and writing is retried every %g s",
                    error.strerror,
                    _RETRY_SECONDS,
                )
            self._failed_at = time.monotonic()
            return
        if self._failed_at is not None:
            self._failed_at = None
            _logger.info("metrics are written again")

    def _close_writers(self) -> None:
        for writer in self._writers:
            with contextlib.suppress(OSError):  # the failed write was logged before
                writer.close()
        self._writers.clear()
