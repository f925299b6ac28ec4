"""Reading the rows that a learner adds to metrics.csv."""

import csv
from collections.abc import Iterator
from pathlib import Path

from daedalus.learner.reporting.metrics_file import numbers


class MetricsFollower:
    """Reader of the complete rows of a metrics.csv that grows. It keeps no file open between two calls.

    If a row has new columns, the writer of the file writes it anew, with all rows so far. A resumed run appends rows
    that begin again at its checkpoint.
    """

    def __init__(self, path: Path, taken: int = 0) -> None:
        """Construct the reader. `taken` is the number of rows to leave out at the beginning."""
        self._path = path
        self.taken = taken  # number of rows that were read, and whose use has ended without an exception
        self._header = b""
        self._at = 0  # bytes, after the rows that were taken

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
            if header != self._header:
                self._header, self._at = header, file.tell()
                for _ in range(self.taken):
                    self._at += len(file.readline())
            columns = _cells(header)
            file.seek(self._at)
            while (line := file.readline()).endswith(b"\n"):
                row = numbers(columns, _cells(line))
                yield row if "env_steps" in row else {}
                self.taken += 1
                self._at += len(line)


def _cells(line: bytes) -> list[str]:
    try:
        return next(csv.reader([line.decode("utf-8", "replace")]), [])
    except csv.Error:
        return []
