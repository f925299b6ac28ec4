"""Metrics writer for a CSV file."""

import csv
import errno
import io
import logging
import math
import os
from array import array
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from itertools import compress, islice
from pathlib import Path

import numpy as np

from daedalus.learner.reporting import thinning
from daedalus.learner.reporting.metrics_rows import COLUMNS, Details, lasting, numbers
from daedalus.learner.reporting.thinning import bounded, line_bytes
from daedalus.policy.saving.regular_files import append_own, replacing
from daedalus.protocol.texts import exact_number

_BLOCK_BYTES = 1 << 16

_logger = logging.getLogger(__name__)


class CsvWriter:
    """Writer that appends one line for each row. A resumed run continues its file, after `cut_rows`.

    Lines are complete: one that was written in part, because the disk was full or the machine crashed, is removed. A
    row with new columns, such as the first scalar of the environment's info, adds them to the header, for which the
    file is written anew. So it is when it has more than MAX_BYTES, with its old rows merged.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        for beside in path.parent.glob(f".{path.name}.*.partial"):  # of a process that was killed meanwhile
            beside.unlink(missing_ok=True)
        _remove_partial_line(path)
        self._columns = _header(path)  # another release may have had other columns
        self._file = append_own(path)
        self._thin_at = thinning.MAX_BYTES
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
        if self._size() > self._thin_at:
            self._thin()

    def _size(self) -> int:
        return os.fstat(self._file.fileno()).st_size

    def _append(self, cells: Sequence[str]) -> None:
        data = _line(cells)
        before = self._size()
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
        rows = islice(_rows(self._path), 1, None)
        _rewrite(self._path, columns, ([*cells, *[""] * len(names)] for cells in rows))
        self._reopen()
        self._columns = columns

    def _thin(self) -> None:
        """Write the file anew with its old rows merged. It stays as it is if the disk has no room for that."""
        try:
            thin_file(self._path)
        except OSError as error:
            _logger.warning("old rows of %s are not merged yet: %s", self._path.name, error.strerror)
        self._reopen()
        self._thin_at = max(thinning.MAX_BYTES, self._size() + thinning.MAX_BYTES // 4)

    def _reopen(self) -> None:
        """Continue the file that has taken the place of the open one."""
        self._file.close()
        self._file = append_own(self._path)

    def close(self) -> None:
        """Close the file. See MetricsWriter."""
        self._file.close()


def cut_rows(path: Path, env_steps: int) -> list[dict[str, float]]:
    """Remove the rows that a run undoes when it continues at `env_steps`, and return them; and those undone before.

    A file of an earlier release, which may be of any size, is thinned too. Raises OSError.
    """
    if not path.exists():
        return []
    _remove_partial_line(path)
    columns = list(_header(path))
    found = array("d")  # env_steps and wall_seconds
    places = [columns.index(name) if name in columns else -1 for name in ("env_steps", "wall_seconds")]
    for cells in islice(_rows(path), 1, None):
        values = [*_values(columns, cells), math.nan]
        found.extend([values[place] for place in places])
    steps, seconds = np.frombuffer(found).reshape(-1, 2).T
    kept, undone = lasting(steps, seconds), steps > env_steps
    removed = compress(islice(_rows(path), 1, None), kept & undone)
    rows = [numbers(columns, list(cells)) for cells in removed]
    kept &= ~undone
    if not kept.all():
        _rewrite(path, columns, compress(islice(_rows(path), 1, None), kept))
    thin_file(path)
    return rows


def thin_file(path: Path) -> None:
    """Merge old rows of a metrics.csv that has more than MAX_BYTES. Raises OSError: then the file is as it was."""
    before = path.stat().st_size
    if before <= thinning.MAX_BYTES:
        return
    columns = list(_header(path))
    rows = ((line_bytes(cells), _values(columns, cells)) for cells in islice(_rows(path), 1, None))
    values = bounded(columns, rows).tolist()
    _rewrite(path, columns, ([exact_number(cell if math.isfinite(cell) else None) for cell in row] for row in values))
    _logger.info(
        "%s had %.0f MiB and has %.1f MiB: old rows are merged, the newest are as they were",
        *(path.name, before / 2**20, path.stat().st_size / 2**20),
    )


def _values(columns: list[str], cells: Sequence[str]) -> list[float]:
    """Return the values of a line, one for each column; NaN: no value."""
    with suppress(ValueError):
        values = [float(cell) if cell else math.nan for cell in cells]
        if len(values) == len(columns):
            return values
    row = numbers(columns, list(cells))  # a damaged line
    return [row.get(name, math.nan) for name in columns]


def _rewrite(path: Path, columns: Sequence[str], rows: Iterable[Sequence[str]]) -> None:
    """Write a file anew in one step, also if the machine crashes meanwhile. Raises OSError."""
    with replacing(path) as beside, open(beside, "wb") as new:
        new.write(_line(columns))
        new.writelines(_line(cells) for cells in rows)
        new.flush()
        os.fsync(new.fileno())


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
