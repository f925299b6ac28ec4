"""Reading metrics.csv, which may be damaged or of another release."""

import csv
import math
from collections.abc import Iterator
from pathlib import Path

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
