"""Bounded metrics of a long run: old rows are merged with their neighbours, the newest rows stay as they are.

The row that replaces several has the newest value of each column, so its counters and its statistics of the newest
episodes are exact; means since the row before (MEANS) become means since the row before that remains.
"""

import threading
from array import array
from collections.abc import Iterable, Mapping, Sequence
from itertools import islice

import numpy as np

from daedalus.learner.reporting.metrics_rows import COLUMNS, MAX_COLUMNS, MEANS
from daedalus.protocol.messages import MAX_PAGE_VALUES, MetricsPage, MetricsReport

MAX_BYTES = 16 << 20  # of metrics.csv: about four hours of rows at the default log interval
_MOST_STEPS = 2.0**62  # more are damage, or the file of somebody else


def merge(columns: Sequence[str], values: np.ndarray, last: np.ndarray, before: Mapping[str, float]) -> np.ndarray:
    """Return one row for each of several groups of consecutive rows, [groups, columns].

    Args:
      columns: names of the columns.
      values: the rows, [rows, columns]; NaN: no value.
      last: index of the last row of each group, increasing, [groups]; the last one is that of the last row.
      before: the row before the first one. Counters that it does not have began at 0.
    """
    first, names = np.append(0, last[:-1] + 1), list(columns)
    known = ~np.isnan(values)
    newest = np.maximum.reduceat(np.where(known, np.arange(len(values))[:, None], -1), first)
    result = np.where(newest < 0, np.nan, np.take_along_axis(values, np.maximum(newest, 0), 0))
    for index, name in enumerate(names):
        if MEANS.get(name) not in names:
            continue
        counter = MEANS[name]
        counts = np.fmax.accumulate(np.append(before.get(counter, 0.0), values[:, names.index(counter)]))
        with np.errstate(all="ignore"):  # a file of somebody else may have infinite values
            weights = np.where(known[:, index], np.diff(counts), 0.0)
            shares = weights / np.repeat(np.add.reduceat(weights, first), np.diff(first, append=len(values)))
            means = np.add.reduceat(np.where(weights > 0.0, values[:, index] * shares, 0.0 * shares), first)
        result[:, index] = np.where(np.isfinite(means), means, result[:, index])
    return result


def merged(rows: Sequence[Mapping[str, float]], before: Mapping[str, float]) -> dict[str, float]:
    """Return one row for consecutive ones. `before` is the row before them."""
    if len(rows) == 1:
        return dict(rows[0])
    columns = list(dict.fromkeys(name for row in rows for name in row))
    values = np.array([[row.get(name, np.nan) for name in columns] for row in rows], np.float64)
    (result,) = merge(columns, values, np.array([len(rows) - 1]), before).tolist()
    return dict(zip(columns, result, strict=True))


def thin(columns: Sequence[str], values: np.ndarray) -> np.ndarray:
    """Return at most half of the rows, [rows, columns]: the newest quarter as they are, and older ones merged.

    Of the older rows, those between two multiples of a power of two of env_steps become one, so their distance is even,
    and rows that were merged before stay as they are until a larger power is needed.
    """
    most = max(len(values) // 4, 1)
    old, newest = np.split(values, [max(len(values) - most, 1)])
    steps = old[:, list(columns).index("env_steps")]
    steps = steps[np.maximum.accumulate(np.where(np.isnan(steps), 0, np.arange(len(steps))))]  # of the row before
    steps = np.minimum(np.abs(np.nan_to_num(steps)), _MOST_STEPS)
    width = 1.0
    while np.count_nonzero(ends := np.append(np.diff(steps // width) != 0.0, True)) > most:
        width *= 2.0
    return np.concatenate([merge(columns, old, np.flatnonzero(ends), {}), newest])


def bounded(columns: Sequence[str], rows: Iterable[tuple[int, Sequence[float]]]) -> np.ndarray:
    """Return rows of a file, [rows, columns], in bounded memory: they are thinned whenever they have MAX_BYTES.

    Args:
      columns: names of the columns, with env_steps.
      rows: bytes and values of each line after the header; NaN: no value.
    """
    found, size = array("d"), line_bytes(columns)
    for length, values in rows:
        found.extend(values)
        size += length
        if size > MAX_BYTES:
            before = np.frombuffer(found).reshape(-1, len(columns))
            after = thin(columns, before)
            size = size * len(after) // len(before)
            found = array("d", after.tobytes())
    return np.frombuffer(found).reshape(-1, len(columns))


def line_bytes(cells: Sequence[str]) -> int:
    """Return the bytes of a line of metrics.csv."""
    return sum(map(len, cells)) + len(cells) + 1


MAX_ROWS = 2000  # that are kept

_ORDER = {name: place for place, name in enumerate(COLUMNS)}


class MetricsHistory:
    """Rows by number. Any thread may use it.

    At capacity, every second row is merged with the next one, and later rows are kept at the same distance.
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
        """Merge all rows but the newest whose numbers are not multiples of the distance with the next one."""
        newest = self._next - 1
        if all(number % self._distance == 0 or number == newest for number in self._rows):
            return
        kept: dict[int, dict[str, float]] = {}
        before: dict[str, float] = {}
        group: list[dict[str, float]] = []
        for number, row in self._rows.items():
            group.append(row)
            if number % self._distance == 0 or number == newest:
                kept[number] = before = merged(group, before)
                group = []
        self._rows = kept


def _place(name: str) -> tuple[int, str]:
    return _ORDER.get(name, len(_ORDER)), name
