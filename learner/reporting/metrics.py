"""Columns of the metrics, and the interface of a metrics writer."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np

COLUMNS = (
    "wall_seconds",
    "env_steps",
    "updates",
    "episodes",
    "episode_return_mean",
    "episode_return_std",
    "episode_return_min",
    "episode_return_max",
    "episode_length_mean",
    "env_steps_per_second",
    "updates_per_second",
    "policy_lag_mean",
    "policy_lag_max",
    "actors",
    "rollouts_accepted",
    "rollouts_rejected",
    "updates_skipped",
    "policy_loss",
    "value_loss",
    "entropy",
    "explained_variance",
    "gradient_norm",
    "value_mean",
    "advantage_std",
    "clipped_fraction",
    "evaluation_return_mean",
    "evaluation_return_std",
    "evaluation_length_mean",
    "evaluation_env_steps",
    "learning_rate",
    "entropy_bonus",
)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Details:
    """Metrics that are not single numbers: distributions and a picture of an observation."""

    returns: Sequence[float] = ()  # of the newest episodes
    lengths: Sequence[int] = ()
    action_counts: Mapping[str, Sequence[int]] = field(default_factory=dict)  # by component, since the last
    picture: np.ndarray | None = None  # one observation as the network receives it: uint8 [H, W] or [H, W, 3]


class MetricsWriter(Protocol):
    """Interface of a destination of metrics rows. Only the recorder's thread calls it."""

    def write(self, row: Mapping[str, float], details: Details) -> None:
        """Write a row. Its keys are in COLUMNS; columns without a value yet are absent. Raises OSError."""
        ...

    def close(self) -> None:
        """Write buffered rows and close the files. Raises OSError."""
        ...
