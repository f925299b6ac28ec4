"""Metrics as a CSV file."""

import csv
import io
import os
from collections.abc import Mapping, Sequence
from pathlib import Path

from daedalus.learner.reporting.metrics import COLUMNS, Details


class CsvWriter:
    """One line a row, appended; a resumed run continues its file, in the columns that it was begun with.

    A line is there whole or not at all, also where the disk takes only a part of it.
    """

    def __init__(self, path: Path) -> None:
        begun = _header(path)  # another release may have had other columns
        self._columns = begun or COLUMNS
        self._file = open(path, "ab", buffering=0)  # noqa: SIM115 - closed in close()
        if not begun:
            self._append(COLUMNS)

    def write(self, row: Mapping[str, float], details: Details) -> None:
        """See MetricsWriter."""
        self._append([_cell(row.get(name)) for name in self._columns])

    def _append(self, cells: Sequence[str]) -> None:
        line = io.StringIO()
        csv.writer(line).writerow(cells)
        data = line.getvalue().encode()
        before = os.fstat(self._file.fileno()).st_size
        try:
            written = self._file.write(data)
            if written != len(data):
                self._file.write(data[written:])  # says why there was no room for the rest
        except OSError:
            self._file.truncate(before)
            raise

    def close(self) -> None:
        """See MetricsWriter."""
        self._file.close()


def _header(path: Path) -> Sequence[str]:
    """The columns of a file; none if it is empty or not there."""
    if not path.exists():
        return ()
    with open(path, newline="", encoding="utf-8") as file:
        return next(csv.reader(file), ())


def _cell(value: float | None) -> str:
    return "" if value is None else f"{value:.6g}" if isinstance(value, float) else str(value)
