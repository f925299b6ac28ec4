"""Minibatches of a batch, with targets that are computed once for all passes. Pure functions."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import chain

import torch
from torch import Tensor

from daedalus.algorithms.batch import MAPS, Batch, Pass
from daedalus.algorithms.losses import shares_of
from daedalus.policy.network.layers import Components, map_components

_LARGE_BYTES = 4096  # of one row of a component, from which on it is not copied for a whole pass


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Minibatch:
    """Part of a batch that one update learns from: R rows of B environments.

    R is T for a policy with memory. Without memory R is 1, and B counts single rows.
    """

    observations: Components  # each [R, B, *stacked_shape]
    initial_state: Tensor  # [B, S]
    starts: Tensor  # [R, B] bool
    actions: Components  # each [R, B, D]
    masks: Components  # of the masked actions [R, B, choices] bool
    log_probs: Tensor  # [R, B], log-probabilities of the proximal policy
    values: Tensor  # [R, B], of the network before the first pass
    targets: Tensor  # [R, B], value targets
    factors: Tensor  # [R, B], of the rows in the policy loss
    shares: Tensor  # [R, B] float32, of the rows in a mean: 1/N for each of N valid rows, else 0

    def tensors(self) -> list[Tensor]:
        """Return all tensors of the minibatch, in the order of the fields."""
        maps = (getattr(self, name).values() for name in MAPS)
        return [*chain.from_iterable(maps), *(getattr(self, name) for name in _ARRAYS)]

    def with_tensors(self, tensors: Sequence[Tensor]) -> "Minibatch":
        """Return a minibatch with other tensors, in the order of `tensors`."""
        remaining = iter(tensors)
        maps = {name: {key: next(remaining) for key in getattr(self, name)} for name in MAPS}
        return replace(self, **maps, **dict(zip(_ARRAYS, remaining, strict=True)))


_ARRAYS = ("initial_state", "starts", "log_probs", "values", "targets", "factors", "shares")


def draw_pass(valid: Tensor, count: int, *, has_memory: bool) -> Pass:
    """Draw the minibatches of one pass over a batch on the CPU: a device then waits for no number of rows.

    With memory, a batch is split by environment, because the memory learns from consecutive rows. Without memory, it
    is split into single rows, and reset rows are omitted. A batch with fewer parts than `count` makes as many
    minibatches as it has parts, so that none is empty. All have one size, that of a batch without reset rows: rows that
    are missing are filled up by a copy of another row whose share is 0.

    Args:
      valid: [T, B] float32 on the CPU, 1 for the rows to learn from.
      count: largest number of minibatches.
      has_memory: whether the policy has one.
    """
    if has_memory:
        return Pass(torch.randperm(valid.shape[1]), valid.new_zeros(0))
    rows = valid.flatten().nonzero().squeeze(1)  # [N]
    order = rows[torch.randperm(len(rows))]
    number = min(count, len(order))
    if not number:
        return Pass(rows.new_zeros((0, 1)), valid.new_zeros((0, 1)))
    split = order.tensor_split(number)
    size = -(-valid.numel() // number)
    shares = valid.new_zeros((number, size))
    for row, part in zip(shares, split, strict=True):
        row[: len(part)] = 1.0 / len(part)
    return Pass(torch.stack([_filled_up(part, size) for part in split]), shares)


def minibatches(
    batch: Batch, log_probs: Tensor, values: Tensor, targets: Tensor, factors: Tensor, count: int, drawn: Pass
) -> Iterator[Minibatch]:
    """Return one shuffled pass over a batch as `count` minibatches of nearly equal size.

    Args:
      log_probs: [T, B], log-probabilities of the actions under the proximal policy.
      values: [T, B], of the network before the first pass.
      targets: [T, B], value targets.
      factors: [T, B], of the rows in the policy loss.
      count: largest number of minibatches.
      drawn: result of `draw_pass`, with the same `count`, on the device of the batch.
    """
    if batch.initial_state.shape[1]:
        return _by_environment(
            batch, log_probs, values, targets, factors, drawn.parts.tensor_split(min(count, len(drawn.parts)))
        )
    return _by_row(batch, log_probs, values, targets, factors, drawn)


def _by_environment(
    batch: Batch, log_probs: Tensor, values: Tensor, targets: Tensor, factors: Tensor, parts: Sequence[Tensor]
) -> Iterator[Minibatch]:
    for part in parts:
        yield Minibatch(
            observations=map_components(batch.observations, partial(_columns, part=part, rows=len(batch.rewards))),
            initial_state=batch.initial_state[part],
            starts=batch.starts[:-1, part],
            actions=map_components(batch.actions, partial(_columns, part=part)),
            masks=map_components(batch.masks, partial(_columns, part=part)),
            log_probs=log_probs[:, part],
            values=values[:, part],
            targets=targets[:, part],
            factors=factors[:, part],
            shares=shares_of(batch.valid[:, part]),
        )


def _by_row(
    batch: Batch, log_probs: Tensor, values: Tensor, targets: Tensor, factors: Tensor, drawn: Pass
) -> Iterator[Minibatch]:
    number, size = drawn.parts.shape
    order = drawn.parts.flatten()
    state = batch.initial_state.new_zeros((size, 0))

    def parts_of(values: Tensor) -> tuple[Tensor, ...]:
        """Gather values of rows [T, B, ...] in the order of the pass, and split them: [1, n, ...] each.

        One gather for each array and pass, and views of it: gathering each minibatch would take as many operations as
        there are minibatches, and small ones cost as much as large ones.
        """
        return values.flatten(0, 1)[order].unsqueeze(0).split(size, dim=1)

    # Of images a second copy of the whole batch would be too much.
    large = {name: values for name, values in batch.observations.items() if values[0, 0].nbytes > _LARGE_BYTES}
    small = {name: parts_of(values) for name, values in batch.observations.items() if name not in large}
    actions = {name: parts_of(values) for name, values in batch.actions.items()}
    masks = {name: parts_of(values) for name, values in batch.masks.items()}
    arrays = [parts_of(values) for values in (batch.starts, log_probs, values, targets, factors)]
    shares = drawn.shares.unsqueeze(1)  # [M, 1, N]
    for index in range(number):
        starts, own_log_probs, own_values, own_targets, own_factors = (parts[index] for parts in arrays)
        gathered = map_components(large, partial(_rows, rows=drawn.parts[index]))
        yield Minibatch(
            observations={name: parts[index] for name, parts in small.items()} | gathered,
            initial_state=state,
            starts=starts,
            actions={name: parts[index] for name, parts in actions.items()},
            masks={name: parts[index] for name, parts in masks.items()},
            log_probs=own_log_probs,
            values=own_values,
            targets=own_targets,
            factors=own_factors,
            shares=shares[index],
        )


def _filled_up(rows: Tensor, size: int) -> Tensor:
    """Return the numbers of rows, and copies of the first so that there are `size`."""
    return torch.cat([rows, rows[:1].expand(size - len(rows))])


def _columns(values: Tensor, part: Tensor, rows: int | None = None) -> Tensor:
    return values[:rows, part]


def _rows(values: Tensor, rows: Tensor) -> Tensor:
    """Return rows of [T, B, ...] by their numbers in T x B, as [1, N, ...]."""
    return values.flatten(0, 1)[rows].unsqueeze(0)
