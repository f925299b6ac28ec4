"""Columns of the metrics, and the interface of a metrics writer."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np

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
