"""Rows of the metrics of a whole run, bounded, for operators who watch it. State; no I/O."""

import threading
from collections.abc import Mapping
from itertools import islice

import numpy as np

from daedalus.learner.reporting.metrics import COLUMNS, GROUPS, MAX_COLUMNS
from daedalus.protocol.messages import MAX_PAGE_VALUES, MetricsPage, MetricsReport

MAX_ROWS = 2000  # that are kept

_ORDER = {name: place for place, name in enumerate(COLUMNS)}
_EVALUATION = GROUPS["evaluation"]


class MetricsHistory:
    """Rows by number. Any thread may use it.

    At capacity, every second row is dropped, and later rows are kept at the same distance. An evaluation, which has
    values in one row only, moves from a dropped row to the next one.
    """

    def __init__(self) -> None:
        self._lock = threading.Lock()  # guards all below
        self._rows: dict[int, dict[str, float]] = {}  # by number
        self._next = 0  # number of the next row
        self._distance = 1  # between the numbers of kept rows; the newest row is kept too

    def add(self, row: Mapping[str, float]) -> None:
        """Add a row. Rows with more env_steps are removed: a resumed run has undone them."""
        with self._lock:
            while self._rows and self._last()["env_steps"] > row["env_steps"]:
                del self._rows[next(reversed(self._rows))]
            self._rows[self._next] = dict(row)
            self._next += 1
            self._thin()
            if len(self._rows) > MAX_ROWS:
                self._distance *= 2
                self._thin()

    def rows(self) -> list[dict[str, float]]:
        """Return all rows that are kept."""
        with self._lock:
            return list(self._rows.values())

    def page(self, run: str, learner_epoch: int, first: int) -> MetricsReport:
        """Return the rows from number `first` on, as many as a page may have."""
        with self._lock:
            found = {number: row for number, row in self._rows.items() if number >= first}
        columns = sorted({name for row in found.values() for name in row}, key=_place)[:MAX_COLUMNS]
        numbers = list(islice(found, MAX_PAGE_VALUES // max(len(columns), 1)))
        values = np.array([[found[number].get(name, np.nan) for name in columns] for number in numbers], np.float64)
        return MetricsReport(
            page=MetricsPage(run=run, learner_epoch=learner_epoch, columns=tuple(columns)),
            numbers=np.array(numbers, np.int64),
            values=values.reshape(len(numbers), len(columns)),
        )

    def _last(self) -> dict[str, float]:
        return self._rows[next(reversed(self._rows))]

    def _thin(self) -> None:
        """Drop all rows but the newest whose numbers are not multiples of the distance."""
        newest = self._next - 1
        dropped = [number for number in self._rows if number % self._distance and number != newest]
        if not dropped:
            return
        kept: dict[int, dict[str, float]] = {}
        evaluation: dict[str, float] = {}
        for number, row in self._rows.items():
            if number % self._distance and number != newest:
                evaluation = {name: row[name] for name in _EVALUATION if name in row} or evaluation
            else:
                kept[number] = {**evaluation, **row}
                evaluation = {}
        self._rows = kept


def _place(name: str) -> tuple[int, str]:
    return _ORDER.get(name, len(_ORDER)), name
