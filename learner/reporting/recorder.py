"""Hands metrics rows to the writers and the progress line.

Works on a thread of its own: a slow disk, and the loading of TensorBoard, cost training nothing.
"""

import contextlib
import logging
import queue
import threading
import time
from pathlib import Path

from daedalus.learner.reporting.metrics import CsvWriter, Details, MetricsWriter, MetricsWriters, TensorBoardWriter
from daedalus.learner.reporting.progress import Progress
from daedalus.learner.run.run_directory import METRICS

_logger = logging.getLogger(__name__)

_QUEUED_ROWS = 256  # beyond that rows are left out rather than waited for
_RETRY_SECONDS = 10.0  # after the disk refused a row


class Recorder:
    """Writes rows in the order they come. `close` waits for the last."""

    def __init__(self, directory: Path, progress: Progress) -> None:
        self._progress = progress
        self._directory = directory
        self._writer: MetricsWriter | None = None
        self._refused_at: float | None = None
        self._rows: queue.Queue[tuple[dict[str, float], Details] | None] = queue.Queue(_QUEUED_ROWS)
        self._thread = threading.Thread(target=self._work, name="recorder", daemon=True)
        self._thread.start()

    def record(self, row: dict[str, float], details: Details) -> None:
        """Takes a row; never waits."""
        with contextlib.suppress(queue.Full):
            self._rows.put_nowait((row, details))

    def close(self) -> None:
        """Writes what is left."""
        self._rows.put(None)
        self._thread.join(timeout=5.0)
        self._progress.end()

    def _work(self) -> None:
        while (taken := self._rows.get()) is not None:
            self._progress.show(taken[0])
            if self._refused_at is None or time.monotonic() >= self._refused_at + _RETRY_SECONDS:
                self._write(*taken)
        self._let_go()

    def _write(self, row: dict[str, float], details: Details) -> None:
        """Writes a row; where the disk refuses it, it is left out, and files are opened anew for a later one."""
        try:
            if self._writer is None:
                self._writer = MetricsWriters(
                    [CsvWriter(self._directory / METRICS), TensorBoardWriter(self._directory)]
                )
            self._writer.write(row, details)
        except OSError as error:
            self._let_go()
            if self._refused_at is None:
                _logger.warning("metrics cannot be written (%s); training goes on", error.strerror)
            self._refused_at = time.monotonic()
            return
        if self._refused_at is not None:
            self._refused_at = None
            _logger.info("metrics are written again")

    def _let_go(self) -> None:
        if self._writer is not None:
            with contextlib.suppress(OSError):  # what it could not write was told already
                self._writer.close()
            self._writer = None
