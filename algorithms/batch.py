"""Rollouts joined on the environment axis, as tensors in reused memory; stacks of frames, made on the device."""

import itertools
import os
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from daedalus.policy.network.layers import Components, map_components
from daedalus.protocol.spaces import ContinuousSpace, DiscreteSpace, Spaces
from daedalus.protocol.uploads import Rollout


class Pass(NamedTuple):
    """The minibatches of one pass over a batch, which algorithms/minibatches.py draws on the CPU."""

    parts: Tensor  # [M, N] int64, rows of each minibatch in T x B; with a memory [B], its environments in order
    shares: Tensor  # [M, N] float32, of the rows in a mean: 1/n for each of n rows, and 0 for copies; with a memory [0]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Batch:
    """Rollouts joined on the environment axis: T rows of B environments. Maps are by component.

    As `BatchAssembler.join` returns it, `observations` has the frames of a component with a frame stack of k, each
    once: [k-1 + T+1, B, *frame_shape]. `to` makes the stacks.
    """

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

    passes: Sequence[Pass] = ()  # of an algorithm that learns from minibatches; empty: drawn when they are needed
    depths: Mapping[str, int] = field(
        default_factory=lambda: MappingProxyType({})
    )  # k, where the frames are not stacked

    def to(self, device: torch.device) -> "Batch":
        """Return the batch on a device, with stacked observations. Copies from pinned memory are asynchronous."""
        return self.moved(lambda values: values.to(device, non_blocking=True)).stacked()

    def moved(self, move: Callable[[Tensor], Tensor]) -> "Batch":
        """Return the batch with a function applied to each of its tensors."""
        changed: dict[str, Any] = {name: map_components(getattr(self, name), move) for name in MAPS}
        changed |= {name: move(getattr(self, name)) for name in _ARRAYS}
        return replace(self, **changed, passes=[Pass(*map(move, each)) for each in self.passes])

    def stacked(self) -> "Batch":
        """Return the batch with stacked observations."""
        made = {name: stacks_of(self.observations[name], self.starts, depth) for name, depth in self.depths.items()}
        return replace(self, observations=self.observations | made, depths={}) if made else self

    def narrowed(self, width: int) -> "Batch":
        """Return the first environments of the batch, without passes."""
        rows = self.moved(lambda values: values[:, :width])
        return replace(rows, initial_state=self.initial_state[:width], passes=())

    def tensors(self) -> list[Tensor]:
        """Return all tensors of the batch, in an order that its shapes alone decide."""
        found: list[Tensor] = []
        self.moved(lambda values: found.append(values) or values)
        return found


MAPS = ("observations", "actions", "masks")  # the fields with one array for each component
_ARRAYS = ("initial_state", "starts", "behaviour_log_probs", "rewards", "terminated", "truncated", "valid")


def stacks_of(frames: Tensor, starts: Tensor, depth: int) -> Tensor:
    """Return the stacks of frames of all rows: the newest k, oldest first, [R, B, k, *frame_shape].

    At the start of an episode its first frame replaces the frames before it, as in an actor (protocol/frames.py).

    Args:
      frames: [k-1 + R, B, *frame_shape]; the first k are the complete stack of row 0.
      starts: [R, B] bool, an episode starts with the row.
      depth: k.
    """
    rows, width = starts.shape
    numbers = torch.arange(rows, device=frames.device)
    first = (starts * (numbers + depth - 1).unsqueeze(1)).cummax(0).values  # [R, B], the first frame of the episode
    ages = torch.arange(depth, device=frames.device)
    chosen = (numbers.unsqueeze(1) + ages).unsqueeze(1).maximum(first.unsqueeze(2))  # [R, B, k]
    places = chosen * width + torch.arange(width, device=frames.device).unsqueeze(1)
    stacks = frames.flatten(0, 1).index_select(0, places.flatten())
    return stacks.view(rows, width, depth, *frames.shape[2:])


_LARGE_BYTES = 1 << 20  # of a rollout, from which on several threads copy
_MOST_THREADS = 8
_PINNED = 3  # one is copied to the device, and the next one is joined, and again without rollouts that are far outside


class BatchAssembler:
    """Assembler of batches from rollouts of equal length. Every array is copied once.

    A batch is valid until the next `join` with the same sizes, which overwrites its memory. Where the batches go to
    another device, the memory is pinned, and there is enough that three batches are valid.
    """

    def __init__(self, spaces: Spaces, device: torch.device, threads: int | None = None) -> None:
        """Construct the assembler.

        Args:
          spaces: components of the rollouts.
          device: where the batches go.
          threads: that copy large rollouts, without the interpreter lock; None: one, or for another device, which
            computes meanwhile, as many as there are cores to spare.
        """
        self._spaces = spaces
        self._pinned = device.type == "cuda"
        self._memories: list[dict[str, Tensor]] = [{} for _ in range(_PINNED if self._pinned else 1)]
        if threads is None:
            threads = min((os.cpu_count() or 1) // 2, _MOST_THREADS) if self._pinned else 1
        self._threads = ThreadPoolExecutor(threads, thread_name_prefix="join") if threads > 1 else None
        self._depths = {name: space.frames for name, space in spaces.observations.items() if space.frames > 1}

    def join(self, rollouts: Sequence[Rollout]) -> Batch:
        """Return one batch of all rollouts, in the given order."""
        rows = rollouts[0].rows
        width = sum(rollout.environments for rollout in rollouts)
        self._memories.append(self._memories.pop(0))
        batch = self.allocate(rows, width, rollouts[0].initial_state.shape[1])
        ends = list(itertools.accumulate(rollout.environments for rollout in rollouts))
        columns = [slice(end - rollout.environments, end) for end, rollout in zip(ends, rollouts, strict=True)]
        if self._threads is not None and rollouts[0].nbytes >= _LARGE_BYTES:
            for _ in self._threads.map(self._copy, rollouts, itertools.repeat(batch), columns):
                pass  # an exception of a thread is raised here
        else:
            for rollout, part in zip(rollouts, columns, strict=True):
                self._copy(rollout, batch, part)
        return batch

    def allocate(self, rows: int, width: int, state_size: int) -> Batch:
        """Return the memory of a batch: T rows of B environments. It is zeros at first, later the last batch."""

        def rows_of(name: str, dtype: str, *shape: int, extra: int = 0) -> Tensor:
            return self._array(name, (rows + extra, width, *shape), dtype)

        spaces = self._spaces
        return Batch(
            observations={
                name: rows_of(f"observations/{name}", _dtype(space), *space.shape, extra=space.frames)
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
            depths=self._depths,
        )

    def _array(self, name: str, shape: tuple[int, ...], dtype: str) -> Tensor:
        array = self._memories[-1].get(name)
        if array is None or array.shape != shape:
            array = torch.zeros(shape, dtype=getattr(torch, dtype), pin_memory=self._pinned)
            self._memories[-1][name] = array
        return array

    def _copy(self, rollout: Rollout, batch: Batch, columns: slice) -> None:
        for name, frames in rollout.frames.items():
            batch.observations[name].numpy()[:, columns] = frames
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
