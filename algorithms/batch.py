"""Rollouts joined on the environment axis, as tensors in reused memory."""

from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import Any

import numpy as np
import torch
from torch import Tensor

from daedalus.policy.network.layers import Components, map_components
from daedalus.protocol.frames import stack_rows
from daedalus.protocol.spaces import ContinuousSpace, DiscreteSpace, Spaces
from daedalus.protocol.uploads import Rollout


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Batch:
    """Rollouts joined on the environment axis: T rows of B environments. Maps are by component."""

    observations: Components  # each [T+1, B, *stacked_shape]; discrete ones int64
    initial_state: Tensor  # [B, S], the recurrent state of the policy at row 0
    starts: Tensor  # [T+1, B] bool, an episode starts here and the recurrent state is 0; never at row 0
    actions: Components  # each [T, B, D], int64 or float32
    masks: Components  # of the masked actions [T, B, choices] bool
    behaviour_log_probs: Tensor  # [T, B]
    rewards: Tensor  # [T, B]
    terminated: Tensor  # [T, B] bool
    truncated: Tensor  # [T, B] bool; also where the next row is overridden: the return is bootstrapped there
    valid: Tensor  # [T, B] float32, 1 for the rows to learn from, 0 for reset rows and overridden rows

    def to(self, device: torch.device) -> "Batch":
        """Return the batch on a device. Copies from pinned memory are asynchronous."""
        if device.type == "cpu":
            return self

        def moved(values: Tensor) -> Tensor:
            return values.to(device, non_blocking=True)

        mapped: dict[str, Any] = {}
        for part in fields(self):
            values = getattr(self, part.name)
            mapped[part.name] = map_components(values, moved) if isinstance(values, dict) else moved(values)
        return Batch(**mapped)


class BatchAssembler:
    """Assembler of batches from rollouts of equal length. Every array is copied once.

    A batch is valid until the next `join` with the same sizes, which overwrites its memory.
    """

    def __init__(self, spaces: Spaces, device: torch.device) -> None:
        self._spaces = spaces
        self._pinned = device.type == "cuda"
        self._memory: dict[str, Tensor] = {}

    def join(self, rollouts: Sequence[Rollout]) -> Batch:
        """Return one batch of all rollouts, in the given order."""
        rows = rollouts[0].rows
        width = sum(rollout.environments for rollout in rollouts)
        batch = self.allocate(rows, width, rollouts[0].initial_state.shape[1])
        first = 0
        for rollout in rollouts:
            self._copy(rollout, batch, slice(first, first + rollout.environments))
            first += rollout.environments
        return batch

    def allocate(self, rows: int, width: int, state_size: int) -> Batch:
        """Return the memory of a batch: T rows of B environments. It is zeros at first, later the last batch."""

        def rows_of(name: str, dtype: str, *shape: int, extra: int = 0) -> Tensor:
            return self._array(name, (rows + extra, width, *shape), dtype)

        spaces = self._spaces
        return Batch(
            observations={
                name: rows_of(f"observations/{name}", _dtype(space), *space.stacked_shape, extra=1)
                for name, space in spaces.observations.items()
            },
            initial_state=self._array("initial_state", (width, state_size), "float32"),
            starts=rows_of("starts", "bool", extra=1),
            actions={
                name: rows_of(f"actions/{name}", _dtype(space), space.size) for name, space in spaces.actions.items()
            },
            masks={name: rows_of(f"masks/{name}", "bool", size) for name, size in spaces.masks.items()},
            behaviour_log_probs=rows_of("behaviour_log_probs", "float32"),
            rewards=rows_of("rewards", "float32"),
            terminated=rows_of("terminated", "bool"),
            truncated=rows_of("truncated", "bool"),
            valid=rows_of("valid", "float32"),
        )

    def _array(self, name: str, shape: tuple[int, ...], dtype: str) -> Tensor:
        array = self._memory.get(name)
        if array is None or array.shape != shape:
            array = torch.zeros(shape, dtype=getattr(torch, dtype), pin_memory=self._pinned)
            self._memory[name] = array
        return array

    def _copy(self, rollout: Rollout, batch: Batch, columns: slice) -> None:
        for name, space in self._spaces.observations.items():
            into = batch.observations[name].numpy()[:, columns]
            if space.frames == 1:
                into[:] = rollout.frames[name]
            else:
                stack_rows(rollout.frames[name], rollout.valid, into)
        batch.initial_state.numpy()[columns] = rollout.initial_state
        np.logical_not(rollout.valid, out=batch.starts.numpy()[1:, columns])
        for kind in ("actions", "masks"):
            for name, values in getattr(rollout, kind).items():
                getattr(batch, kind)[name].numpy()[:, columns] = values
        for name in ("behaviour_log_probs", "rewards", "terminated", "truncated"):
            getattr(batch, name).numpy()[:, columns] = getattr(rollout, name)
        batch.valid.numpy()[:, columns] = rollout.learned
        if rollout.overridden is not None:
            batch.truncated.numpy()[:-1, columns] |= rollout.overridden[1:]


def _dtype(space: Any) -> str:
    """Return the data type of a component in a batch."""
    match space:
        case DiscreteSpace():
            return "int64"
        case ContinuousSpace():
            return "float32"
        case _:
            return space.dtype
