"""Metrics rows: their columns, the interface of a writer, reading metrics.csv, and the history of a whole run."""

import csv
import math
import threading
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import islice
from pathlib import Path
from typing import Protocol

import numpy as np

from daedalus.protocol.messages import MAX_PAGE_VALUES, MetricsPage, MetricsReport

# By the group that TensorBoard shows them in. docs/reference/metrics.md explains each column.
GROUPS: dict[str, tuple[str, ...]] = {
    "time": ("wall_seconds", "env_steps", "updates", "env_steps_per_second", "updates_per_second"),
    "rollout": (
        "episodes",
        "episode_return_mean",
        "episode_return_std",
        "episode_return_min",
        "episode_return_max",
        "episode_length_mean",
        "policy_lag_mean",
        "policy_lag_max",
        "actors",
        "rollouts_accepted",
        "rollouts_rejected",
    ),
    "train": (
        "updates_skipped",
        "policy_loss",
        "value_loss",
        "entropy",
        "explained_variance",
        "gradient_norm",
        "gradient_clipped_fraction",
        "value_mean",
        "advantage_std",
        "clipped_fraction",
        "behaviour_kl",
        "rho_mean",
        "rho_effective_share",
        "rho_clipped_fraction",
        "value_error_p05",
        "value_error_p50",
        "value_error_p95",
        "learning_rate",
        "entropy_bonus",
    ),
    "evaluation": (
        "evaluation_return_mean",
        "evaluation_return_std",
        "evaluation_length_mean",
        "evaluation_env_steps",
    ),
}
COLUMNS = tuple(name for names in GROUPS.values() for name in names)
# Prefixes of columns that a run adds to COLUMNS.
ENV = "env/"  # scalars of the environment's info
USER = "user/"  # metrics of the program that started the run
MAX_COLUMNS = 1024  # that are read; a program of the user's may name a new metric in every row


def tag(column: str) -> str:
    """Return the name of a column with its group: `train/entropy`, `evaluation/return_mean`, `env/lives`."""
    for group, names in GROUPS.items():
        if column in names:
            return f"{group}/{column.removeprefix(group + '_')}"
    return column


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Details:
    """Metrics that are not single numbers: distributions and a picture of an observation. Most rows have none."""

    returns: Sequence[float] = ()  # of the newest episodes
    lengths: Sequence[int] = ()
    action_counts: Mapping[str, Sequence[int]] = field(default_factory=dict)  # by component, since the last
    picture: np.ndarray | None = None  # one observation as the network receives it: uint8 [H, W] or [H, W, 3]


class MetricsWriter(Protocol):
    """Interface of a destination of metrics rows. Only the recorder's thread calls it."""

    def write(self, row: Mapping[str, float], details: Details) -> None:
        """Write a row. Raises OSError.

        Its keys are in COLUMNS, or begin with ENV or USER. Columns without a value yet are absent.
        """
        ...

    def close(self) -> None:
        """Write buffered rows and close the files. Raises OSError."""
        ...


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
