"""Reading the rows that a learner adds to metrics.csv."""

import csv
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO

from daedalus.learner.reporting.metrics_rows import numbers


class MetricsFollower:
    """Reader of the complete rows of a metrics.csv that grows. It keeps no file open between two calls.

    If a row has new columns, the writer of the file writes it anew, with all rows so far. A resumed run writes it anew
    without the rows after its checkpoint, and appends rows that begin again there.
    """

    def __init__(self, path: Path, taken: int = 0) -> None:
        """Construct the reader. `taken` is the number of rows to leave out at the beginning."""
        self._path = path
        self.taken = taken  # number of rows that were read, and whose use has ended without an exception
        self._header = b""
        self._at = 0  # bytes, after the rows that were taken
        self._last = b""  # line before there

    @property
    def exist(self) -> bool:
        """Whether the learner has written to the file."""
        return self._path.exists()

    def rows(self) -> Iterator[dict[str, float]]:
        """Yield the rows since those that were taken. A damaged row is empty. Raises OSError."""
        if not self.exist:
            return
        with open(self._path, "rb") as file:
            header = file.readline()
            if not header.endswith(b"\n"):
                return
            if header != self._header or not self._is_at_last(file):
                file.seek(len(header))
                lines = [line for _, line in zip(range(self.taken), file, strict=False) if line.endswith(b"\n")]
                self._header, self._at = header, len(header) + sum(map(len, lines))
                self._last, self.taken = (lines or [header])[-1], len(lines)
            columns = _cells(header)
            file.seek(self._at)
            while (line := file.readline()).endswith(b"\n"):
                row = numbers(columns, _cells(line))
                yield row if "env_steps" in row else {}
                self.taken += 1
                self._at += len(line)
                self._last = line

    def _is_at_last(self, file: BinaryIO) -> bool:
        """Return whether the line before the position is still the one that was taken last."""
        file.seek(self._at - len(self._last))
        return file.read(len(self._last)) == self._last


def _cells(line: bytes) -> list[str]:
    try:
        return next(csv.reader([line.decode("utf-8", "replace")]), [])
    except csv.Error:
        return []
