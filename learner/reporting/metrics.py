"""What is recorded of a run, and the interface of whatever records it."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
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
    """Metrics that are no single number: they tell convergence apart from collapse."""

    returns: Sequence[float] = ()  # of the newest episodes
    lengths: Sequence[int] = ()
    action_counts: Sequence[int] = ()  # since the details before
    picture: np.ndarray | None = None  # what the network saw at one row: uint8 [H, W] or [H, W, 3]


class MetricsWriter(Protocol):
    """A place that metrics go to, one row at a time. The recorder's thread is the only caller."""

    def write(self, row: Mapping[str, float], details: Details) -> None:
        """Record a row; its keys are among COLUMNS, and those it lacks are unknown yet. Raises OSError."""
        ...

    def close(self) -> None:
        """Write what is buffered, and let go of the files."""
        ...
