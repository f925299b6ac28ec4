"""Rollouts joined on the environment axis, as tensors in memory that is used again."""

from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import Any

import numpy as np
import torch
from torch import Tensor

from daedalus.protocol.frames import stack_rows
from daedalus.protocol.messages import Rollout
from daedalus.protocol.spaces import ArraySpace


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Batch:
    """What is learned from at once; B environments of one or more rollouts, T rows each."""

    observations: Tensor  # [T+1, B, *stacked_shape]
    initial_state: Tensor  # [B, S], the policy's memory at row 0
    starts: Tensor  # [T+1, B] bool, an episode starts at this row and nothing is remembered; never at row 0
    actions: Tensor  # [T, B] int64
    behaviour_log_probs: Tensor  # [T, B]
    rewards: Tensor  # [T, B]
    terminated: Tensor  # [T, B] bool
    truncated: Tensor  # [T, B] bool
    valid: Tensor  # [T, B] float32, 1 or 0

    def to(self, device: torch.device) -> "Batch":
        """The same on a device; copies from pinned memory do not wait."""
        if device.type == "cpu":
            return self
        return Batch(**{part.name: getattr(self, part.name).to(device, non_blocking=True) for part in fields(self)})


class BatchAssembler:
    """Joins rollouts of equal length, in the order given; every array is copied once.

    A batch is good until the next `join` of the same sizes, which writes into the same memory.
    """

    def __init__(self, observation: ArraySpace, device: torch.device) -> None:
        self._space = observation
        self._pinned = device.type == "cuda"
        self._memory: dict[str, Tensor] = {}

    def join(self, rollouts: Sequence[Rollout]) -> Batch:
        """One batch of them all."""
        rows = rollouts[0].rows
        width = sum(rollout.environments for rollout in rollouts)
        space = self._space
        batch = Batch(
            observations=self._room("observations", (rows + 1, width, *space.stacked_shape), space.dtype),
            initial_state=self._room("initial_state", (width, rollouts[0].initial_state.shape[1]), "float32"),
            starts=self._room("starts", (rows + 1, width), "bool"),
            actions=self._room("actions", (rows, width), "int64"),
            behaviour_log_probs=self._room("behaviour_log_probs", (rows, width), "float32"),
            rewards=self._room("rewards", (rows, width), "float32"),
            terminated=self._room("terminated", (rows, width), "bool"),
            truncated=self._room("truncated", (rows, width), "bool"),
            valid=self._room("valid", (rows, width), "float32"),
        )
        into: dict[str, np.ndarray] = {part.name: getattr(batch, part.name).numpy() for part in fields(batch)}
        first = 0
        for rollout in rollouts:
            self._copy(rollout, {name: _columns(name, array, first, rollout) for name, array in into.items()})
            first += rollout.environments
        return batch

    def _room(self, name: str, shape: tuple[int, ...], dtype: str) -> Tensor:
        kept = self._memory.get(name)
        if kept is None or kept.shape != shape:
            kept = torch.zeros(shape, dtype=getattr(torch, dtype), pin_memory=self._pinned)
            self._memory[name] = kept
        return kept

    def _copy(self, rollout: Rollout, into: dict[str, np.ndarray]) -> None:
        if self._space.frames == 1:
            into["observations"][:] = rollout.frames
        else:
            stack_rows(rollout.frames, rollout.valid, into["observations"])
        np.logical_not(rollout.valid, out=into["starts"][1:])
        for name in ("initial_state", "actions", "behaviour_log_probs", "rewards", "terminated", "truncated", "valid"):
            into[name][:] = getattr(rollout, name)


def _columns(name: str, array: Any, first: int, rollout: Rollout) -> np.ndarray:
    """The part of a batch's array that a rollout fills."""
    part = slice(first, first + rollout.environments)
    return array[part] if name == "initial_state" else array[:, part]
