"""Metrics writer for a CSV file."""

import csv
import io
import os
from collections.abc import Mapping, Sequence
from pathlib import Path

from daedalus.learner.reporting.metrics import COLUMNS, Details


class CsvWriter:
    """Writer that appends one line for each row. A resumed run continues its file, with the columns of its header.

    Lines are complete: if the disk is full, a partly written line is removed.
    """

    def __init__(self, path: Path) -> None:
        header = _header(path)  # another release may have had other columns
        self._columns = header or COLUMNS
        self._file = open(path, "ab", buffering=0)  # noqa: SIM115 - closed in close()
        if not header:
            self._append(COLUMNS)

    def write(self, row: Mapping[str, float], details: Details) -> None:
        """Append a line. See MetricsWriter."""
        self._append([_cell(row.get(name)) for name in self._columns])

    def _append(self, cells: Sequence[str]) -> None:
        line = io.StringIO()
        csv.writer(line).writerow(cells)
        data = line.getvalue().encode()
        before = os.fstat(self._file.fileno()).st_size
        try:
            written = self._file.write(data)
            if written != len(data):
                self._file.write(data[written:])  # raises the error that limited the first write
        except OSError:
            self._file.truncate(before)
            raise

    def close(self) -> None:
        """Close the file. See MetricsWriter."""
        self._file.close()


def _header(path: Path) -> Sequence[str]:
    """Return the column names of a file, or an empty sequence if the file is empty or missing."""
    if not path.exists():
        return ()
    with open(path, newline="", encoding="utf-8") as file:
        return next(csv.reader(file), ())


def _cell(value: float | None) -> str:
    return "" if value is None else f"{value:.6g}" if isinstance(value, float) else str(value)
