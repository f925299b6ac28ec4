"""Rollouts joined on the environment axis, as tensors in reused memory."""

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
    """Rollouts joined on the environment axis: T rows of B environments."""

    observations: Tensor  # [T+1, B, *stacked_shape]
    initial_state: Tensor  # [B, S], the recurrent state of the policy at row 0
    starts: Tensor  # [T+1, B] bool, an episode starts here and the recurrent state is 0; never at row 0
    actions: Tensor  # [T, B] int64
    behaviour_log_probs: Tensor  # [T, B]
    rewards: Tensor  # [T, B]
    terminated: Tensor  # [T, B] bool
    truncated: Tensor  # [T, B] bool
    valid: Tensor  # [T, B] float32, 1 or 0

    def to(self, device: torch.device) -> "Batch":
        """Return the batch on a device. Copies from pinned memory are asynchronous."""
        if device.type == "cpu":
            return self
        return Batch(**{part.name: getattr(self, part.name).to(device, non_blocking=True) for part in fields(self)})


class BatchAssembler:
    """Assembler of batches from rollouts of equal length. Every array is copied once.

    A batch is valid until the next `join` with the same sizes, which overwrites its memory.
    """

    def __init__(self, observation: ArraySpace, device: torch.device) -> None:
        self._space = observation
        self._pinned = device.type == "cuda"
        self._memory: dict[str, Tensor] = {}

    def join(self, rollouts: Sequence[Rollout]) -> Batch:
        """Return one batch of all rollouts, in the given order."""
        rows = rollouts[0].rows
        width = sum(rollout.environments for rollout in rollouts)
        space = self._space
        batch = Batch(
            observations=self._array("observations", (rows + 1, width, *space.stacked_shape), space.dtype),
            initial_state=self._array("initial_state", (width, rollouts[0].initial_state.shape[1]), "float32"),
            starts=self._array("starts", (rows + 1, width), "bool"),
            actions=self._array("actions", (rows, width), "int64"),
            behaviour_log_probs=self._array("behaviour_log_probs", (rows, width), "float32"),
            rewards=self._array("rewards", (rows, width), "float32"),
            terminated=self._array("terminated", (rows, width), "bool"),
            truncated=self._array("truncated", (rows, width), "bool"),
            valid=self._array("valid", (rows, width), "float32"),
        )
        into: dict[str, np.ndarray] = {part.name: getattr(batch, part.name).numpy() for part in fields(batch)}
        first = 0
        for rollout in rollouts:
            self._copy(rollout, {name: _columns(name, array, first, rollout) for name, array in into.items()})
            first += rollout.environments
        return batch

    def _array(self, name: str, shape: tuple[int, ...], dtype: str) -> Tensor:
        array = self._memory.get(name)
        if array is None or array.shape != shape:
            array = torch.zeros(shape, dtype=getattr(torch, dtype), pin_memory=self._pinned)
            self._memory[name] = array
        return array

    def _copy(self, rollout: Rollout, into: dict[str, np.ndarray]) -> None:
        if self._space.frames == 1:
            into["observations"][:] = rollout.frames
        else:
            stack_rows(rollout.frames, rollout.valid, into["observations"])
        np.logical_not(rollout.valid, out=into["starts"][1:])
        for name in ("initial_state", "actions", "behaviour_log_probs", "rewards", "terminated", "truncated", "valid"):
            into[name][:] = getattr(rollout, name)


def _columns(name: str, array: Any, first: int, rollout: Rollout) -> np.ndarray:
    """Return a view of the columns of a batch's array that hold a rollout."""
    part = slice(first, first + rollout.environments)
    return array[part] if name == "initial_state" else array[:, part]
