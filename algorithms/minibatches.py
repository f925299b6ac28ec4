"""Minibatches of a batch, with targets that are computed once for all passes. Pure functions."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import chain

import torch
from torch import Tensor

from daedalus.algorithms.batch import Batch
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

    @property
    def names(self) -> tuple[tuple[str, ...], ...]:
        """The names of the components of each map, in the order of the fields."""
        return tuple(tuple(getattr(self, name)) for name in _MAPS)

    def tensors(self) -> list[Tensor]:
        """Return all tensors of the minibatch, in the order of the fields."""
        maps = (getattr(self, name).values() for name in _MAPS)
        return [*chain.from_iterable(maps), *(getattr(self, name) for name in _ARRAYS)]

    def with_tensors(self, tensors: Sequence[Tensor]) -> "Minibatch":
        """Return a minibatch with other tensors, in the order of `tensors`."""
        remaining = iter(tensors)
        maps = {name: {key: next(remaining) for key in getattr(self, name)} for name in _MAPS}
        return replace(self, **maps, **dict(zip(_ARRAYS, remaining, strict=True)))


_MAPS = ("observations", "actions", "masks")
_ARRAYS = ("initial_state", "starts", "log_probs", "values", "targets", "factors", "shares")


def minibatches(
    batch: Batch, log_probs: Tensor, values: Tensor, targets: Tensor, factors: Tensor, count: int
) -> Iterator[Minibatch]:
    """Return one shuffled pass over a batch as `count` minibatches of nearly equal size.

    With memory, a batch is split by environment, because the memory learns from consecutive rows. Without memory, it
    is split into single rows, and reset rows are omitted. A batch with fewer parts than `count` makes as many
    minibatches as it has parts, so that none is empty. All have one size, that of a batch without reset rows: rows that
    are missing are filled up by a copy of another row whose share is 0.

    Args:
      log_probs: [T, B], log-probabilities of the actions under the proximal policy.
      values: [T, B], of the network before the first pass.
      targets: [T, B], value targets.
      factors: [T, B], of the rows in the policy loss.
      count: largest number of minibatches.
    """
    split = _by_environment if batch.initial_state.shape[1] else _by_row
    return split(batch, log_probs, values, targets, factors, count)


def _by_environment(
    batch: Batch, log_probs: Tensor, values: Tensor, targets: Tensor, factors: Tensor, count: int
) -> Iterator[Minibatch]:
    order = torch.randperm(batch.valid.shape[1]).to(batch.valid.device)
    for part in order.tensor_split(min(count, len(order))):
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
    batch: Batch, log_probs: Tensor, values: Tensor, targets: Tensor, factors: Tensor, count: int
) -> Iterator[Minibatch]:
    rows = batch.valid.flatten().nonzero().squeeze(1)  # [N]
    order = rows[torch.randperm(len(rows)).to(rows.device)]
    number = min(count, len(order))
    if not number:
        return
    split = order.tensor_split(number)
    size = -(-batch.valid.numel() // number)
    filled = [_filled_up(part, size) for part in split]
    order = torch.cat(filled)
    shares = {length: _equal_shares(batch.valid, length, size) for length in {len(part) for part in split}}
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
    for index, part in enumerate(filled):
        starts, own_log_probs, own_values, own_targets, own_factors = (parts[index] for parts in arrays)
        gathered = map_components(large, partial(_rows, rows=part))
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
            shares=shares[len(split[index])],
        )


def _filled_up(rows: Tensor, size: int) -> Tensor:
    """Return the numbers of rows, and copies of the first so that there are `size`."""
    return torch.cat([rows, rows[:1].expand(size - len(rows))])


def _equal_shares(like: Tensor, rows: int, size: int) -> Tensor:
    """Return the shares [1, size] of a minibatch whose first rows count, each as much, and the others nothing."""
    shares = like.new_zeros((1, size))
    shares[:, :rows] = 1.0 / rows
    return shares


def _columns(values: Tensor, part: Tensor, rows: int | None = None) -> Tensor:
    return values[:rows, part]


def _rows(values: Tensor, rows: Tensor) -> Tensor:
    """Return rows of [T, B, ...] by their numbers in T x B, as [1, N, ...]."""
    return values.flatten(0, 1)[rows].unsqueeze(0)
