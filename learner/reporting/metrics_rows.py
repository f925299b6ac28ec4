"""Metrics rows: their columns, the interface of a writer, and reading metrics.csv."""

import csv
import math
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Protocol

import numpy as np

from daedalus.protocol.keys import as_name
from daedalus.protocol.league import LeagueStatus

# By the group that TensorBoard shows them in. docs/reference/metrics.md explains each column.
GROUPS: dict[str, tuple[str, ...]] = {
    "time": ("wall_seconds", "env_steps", "agent_steps", "updates", "env_steps_per_second", "updates_per_second"),
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
        "first_visit_fraction",
        "curiosity_reward_mean",
    ),
    "evaluation": (
        "evaluation_return_mean",
        "evaluation_return_std",
        "evaluation_length_mean",
        "evaluation_env_steps",
    ),
    "league": ("rating", "rating_deviation"),
}
COLUMNS = tuple(name for names in GROUPS.values() for name in names)
# Means since the row before, with the counter whose increase since then is their weight. Of all other columns, a row
# has the newest value.
MEANS = {
    "env_steps_per_second": "wall_seconds",
    "updates_per_second": "wall_seconds",
    "policy_lag_mean": "env_steps",
    **dict.fromkeys(
        (
            "policy_loss",
            "value_loss",
            "entropy",
            "explained_variance",
            "gradient_norm",
            "gradient_clipped_fraction",
            "value_mean",
            "advantage_std",
            "clipped_fraction",
        ),
        "updates",
    ),
}
# Prefixes of columns that a run adds to COLUMNS.
ENV = "env/"  # scalars of the environment's info
USER = "user/"  # metrics of the program that started the run
WIN_RATE = "win_rate/"  # of the newest policy against a fixed opponent
LESSON = "lesson/"  # the mean value of a parameter that has a lesson, over the newest episodes
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
    waits_for: str = ""  # what the first batch waits for, for the progress; empty once there is a batch
    picture: np.ndarray | None = None  # one observation as the network receives it: uint8 [H, W] or [H, W, 3]

    @property
    def exist(self) -> bool:
        """Whether there are any."""
        return bool(len(self.returns) or self.action_counts) or self.picture is not None


class MetricsWriter(Protocol):
    """Interface of a destination of metrics rows. Only the recorder's thread calls it."""

    def write(self, row: Mapping[str, float], details: Details) -> None:
        """Write a row. Raises OSError.

        Its keys are in COLUMNS, or begin with ENV, USER, WIN_RATE or LESSON. Columns without a value yet are absent.
        """
        ...

    def close(self) -> None:
        """Write buffered rows and close the files. Raises OSError."""
        ...


def league_columns(league: LeagueStatus) -> dict[str, float]:
    """Return the columns of a game with opponents: the rating of the newest policy, and its win rates."""
    newest = league.newest
    if newest is None:
        return {}
    rates = {_opponent_column(name): rate for name, rate in league.win_rates.items()}
    return {"rating": newest.rating, "rating_deviation": newest.deviation, **rates}


def _opponent_column(name: str) -> str:
    """Return the column of an opponent, `win_rate/my_module.Bot`, in characters that every tracker takes."""
    plain = name.replace(":", ".")
    kept = len(plain) <= 64 and re.fullmatch(r"\w[\w.-]*(/\w[\w.-]*)*", plain, re.ASCII)
    return WIN_RATE + (plain if kept else as_name(name))


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
