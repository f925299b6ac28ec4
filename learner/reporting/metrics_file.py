"""Reading metrics.csv, which may be damaged or of another release."""

import csv
import math
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from daedalus.learner.reporting.metrics import MAX_COLUMNS


def read_rows(path: Path) -> Iterator[dict[str, float]]:
    """Yield the rows of a file: its finite numbers by column. Damaged rows are left out.

    Raises OSError if the file cannot be read, ValueError if it is not the metrics of a run.
    """
    with open(path, newline="", encoding="utf-8", errors="replace") as file:
        lines = csv.reader(file)
        try:
            columns = next(lines, [])
            if "env_steps" not in columns:
                raise ValueError(f"{path} has no column env_steps: it is not the metrics of a run")
            if len(columns) > MAX_COLUMNS:
                raise ValueError(
                    f"{path} has {len(columns):,} columns, and at most {MAX_COLUMNS:,} are read: log fewer metrics"
                )
            for cells in lines:
                row = numbers(columns, cells)
                if "env_steps" in row:
                    yield row
        except csv.Error as error:
            raise ValueError(f"{path} is damaged: {error}") from None


def numbers(columns: list[str], cells: list[str]) -> dict[str, float]:
    """Return the finite numbers of a line, by column."""
    row = {}
    for name, cell in zip(columns, cells, strict=False):
        try:
            value = float(cell)
        except ValueError:
            continue  # empty, or damaged
        if math.isfinite(value):
            row[name] = value
    return row


def lasting(*columns: np.ndarray) -> np.ndarray:
    """Return which rows the run has kept, [rows] bool, from columns that never fall, [rows], such as env_steps.

    A run that continues from a checkpoint undoes the rows after it: a later row has less. NaN: unknown.
    """
    kept = np.ones(len(columns[0]), np.bool_)
    for column in columns:
        least_later = np.fmin.accumulate(np.append(column, np.inf)[::-1])[::-1][1:]
        kept &= ~(column > least_later)
    return kept
