"""Rollouts joined on the environment axis, as tensors."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
import torch
from torch import Tensor

from protocol.messages import Rollout


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Batch:
    """What one update learns from; B environments of one or more rollouts, T rows each."""

    observations: Tensor  # [T+1, B, *observation_shape]
    actions: Tensor  # [T, B] int64
    behaviour_log_probs: Tensor  # [T, B]
    rewards: Tensor  # [T, B]
    terminated: Tensor  # [T, B] bool
    truncated: Tensor  # [T, B] bool
    valid: Tensor  # [T, B] float32, 1 or 0


_Field = Literal["observations", "actions", "behaviour_log_probs", "rewards", "terminated", "truncated", "valid"]


def join_rollouts(rollouts: Sequence[Rollout]) -> Batch:
    """One batch of rollouts of equal length, in the order given; every array is copied once."""

    def joined(name: _Field, dtype: type | None = None) -> Tensor:
        parts = [getattr(rollout, name) for rollout in rollouts]
        return torch.from_numpy(np.concatenate(parts, axis=1, dtype=dtype, casting="unsafe"))

    return Batch(
        observations=joined("observations"),
        actions=joined("actions", np.int64),
        behaviour_log_probs=joined("behaviour_log_probs"),
        rewards=joined("rewards"),
        terminated=joined("terminated"),
        truncated=joined("truncated"),
        valid=joined("valid", np.float32),
    )
