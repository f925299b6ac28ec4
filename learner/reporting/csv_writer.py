"""Metrics writer for a CSV file."""

import csv
import errno
import io
import os
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from itertools import compress, islice
from pathlib import Path

import numpy as np

from daedalus.learner.reporting.metrics_rows import COLUMNS, Details, lasting, numbers
from daedalus.policy.saving.regular_files import append_own, replacing
from daedalus.protocol.texts import exact_number

_BLOCK_BYTES = 1 << 16


class CsvWriter:
    """Writer that appends one line for each row. A resumed run continues its file, after `cut_rows`.

    Lines are complete: one that was written in part, because the disk was full or the machine crashed, is removed. A
    row with new columns, such as the first scalar of the environment's info, adds them to the header, for which the
    file is written anew.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        _remove_partial_line(path)
        self._columns = _header(path)  # another release may have had other columns
        self._file = append_own(path)
        if not self._columns:
            self._append(COLUMNS)
            self._columns = COLUMNS

    def write(self, row: Mapping[str, float], details: Details) -> None:
        """Append a line. See MetricsWriter. Raises OSError also if the file was moved or removed."""
        self._path.stat()
        new = [name for name in row if name not in self._columns]
        if new:
            self._add_columns(new)
        self._append([exact_number(row.get(name)) for name in self._columns])

    def _append(self, cells: Sequence[str]) -> None:
        data = _line(cells)
        before = os.fstat(self._file.fileno()).st_size
        try:
            written = self._file.write(data)
            if written != len(data):
                self._file.write(data[written:])  # raises the error that limited the first write
        except OSError:
            self._file.truncate(before)
            raise

    def _add_columns(self, names: Sequence[str]) -> None:
        """Write the file anew with further columns, which are blank in the rows so far."""
        columns = (*self._columns, *names)
        rows = _rows(self._path)
        next(rows)
        with replacing(self._path) as beside, open(beside, "wb") as new:
            new.write(_line(columns))
            for cells in rows:
                new.write(_line([*cells, *[""] * len(names)]))
        self._file.close()
        self._file = append_own(self._path)
        self._columns = columns

    def close(self) -> None:
        """Close the file. See MetricsWriter."""
        self._file.close()


def cut_rows(path: Path, env_steps: int) -> list[dict[str, float]]:
    """Remove the rows that a run undoes when it continues at `env_steps`, and return them; and those undone before.

    Raises OSError.
    """
    if not path.exists():
        return []
    _remove_partial_line(path)
    columns = list(_header(path))
    read = [numbers(columns, list(cells)) for cells in islice(_rows(path), 1, None)]
    steps, seconds = (np.array([row.get(name, np.nan) for row in read]) for name in ("env_steps", "wall_seconds"))
    newest, undone = lasting(steps, seconds), steps > env_steps
    kept = newest & ~undone
    if not kept.all():
        with replacing(path) as beside, open(beside, "wb") as new:
            new.write(_line(columns))
            new.writelines(_line(cells) for cells in compress(islice(_rows(path), 1, None), kept))
    return list(compress(read, newest & undone))


def _line(cells: Sequence[str]) -> bytes:
    line = io.StringIO()
    csv.writer(line).writerow(cells)
    return line.getvalue().encode()


def _header(path: Path) -> Sequence[str]:
    """Return the column names of a file, or an empty sequence if the file is empty or missing."""
    if not path.exists():
        return ()
    return next(_rows(path), ())


def _remove_partial_line(path: Path) -> None:
    """Remove the part of a line at the end of a file, if the file exists."""
    with suppress(FileNotFoundError), open(path, "rb+") as file:
        length = end = file.seek(0, os.SEEK_END)
        while end > 0:
            begin = max(end - _BLOCK_BYTES, 0)
            file.seek(begin)
            line_end = file.read(end - begin).rfind(b"\n")
            if line_end >= 0:
                end = begin + line_end + 1
                break
            end = begin
        if end < length:
            file.truncate(end)


def _rows(path: Path) -> Iterator[Sequence[str]]:
    """Yield the rows of a file, whose bytes may be damaged. Raises OSError if it has no rows for that reason."""
    with open(path, newline="", encoding="utf-8", errors="replace") as file:
        try:
            yield from csv.reader(file)
        except csv.Error as error:
            raise OSError(errno.EILSEQ, f"{path.name} is damaged ({error}): move it away", str(path)) from None
