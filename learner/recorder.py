"""Hands metrics rows to the writers and the progress line.

Works on a thread of its own: a slow disk, and the loading of TensorBoard, cost training nothing.
"""

import contextlib
import queue
import threading
from collections.abc import Callable
from pathlib import Path

from learner.metrics import CsvWriter, Details, MetricsWriter, MetricsWriters, NullWriter, TensorBoardWriter
from learner.progress import Progress
from learner.run_directory import METRICS

_QUEUED_ROWS = 256  # beyond that rows are left out rather than waited for


class Recorder:
    """Writes rows in the order they come. `close` waits for the last."""

    def __init__(self, directory: Path, progress: Progress) -> None:
        self._progress = progress
        self._directory = directory
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
        writer: MetricsWriter = NullWriter()
        opened = False
        while (taken := self._rows.get()) is not None:
            self._progress.show(taken[0])
            if not opened:
                writer = self._attempt(self._open, NullWriter())
                opened = True
            writer = self._attempt(lambda writer=writer, taken=taken: _written(writer, *taken), NullWriter())
        self._attempt(writer.close, None)

    def _open(self) -> MetricsWriter:
        return MetricsWriters([CsvWriter(self._directory / METRICS), TensorBoardWriter(self._directory)])

    def _attempt(self, action: Callable, otherwise):
        try:
            return action()
        except OSError as error:
            self._progress.say(f"metrics are no longer written: {error}")
            return otherwise


def _written(writer: MetricsWriter, row: dict[str, float], details: Details) -> MetricsWriter:
    writer.write(row, details)
    return writer
