"""Minibatches of a batch, with targets that are computed once for all passes. Pure functions."""

from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial

import torch
from torch import Tensor

from daedalus.algorithms.batch import Batch, Components, each
from daedalus.algorithms.returns import Targets


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
    log_probs: Tensor  # [R, B], log pi(a_t | s_t) before the first update of the batch
    targets: Tensor  # [R, B], value targets
    advantages: Tensor  # [R, B]
    weights: Tensor  # [R, B], of the rows in the policy gradient
    valid: Tensor  # [R, B] float32


def minibatches(batch: Batch, log_probs: Tensor, targets: Targets, count: int) -> Iterator[Minibatch]:
    """Yield one shuffled pass over a batch as `count` minibatches of nearly equal size.

    With memory, a batch is split by environment, because the memory learns from consecutive rows. Without memory, it
    is split into single rows, and reset rows are omitted. A batch with fewer parts than `count` makes as many
    minibatches as it has parts, so that none is empty.

    Args:
      log_probs: [T, B], log pi(a_t | s_t) before the first update of the batch.
      targets: value targets and advantages, [T, B].
    """
    if batch.initial_state.shape[1]:
        order = torch.randperm(batch.rewards.shape[1]).to(batch.rewards.device)
        for part in order.tensor_split(min(count, len(order))):
            yield Minibatch(
                observations=each(batch.observations, partial(_columns, part=part, rows=len(batch.rewards))),
                initial_state=batch.initial_state[part],
                starts=batch.starts[:-1, part],
                actions=each(batch.actions, partial(_columns, part=part)),
                masks=each(batch.masks, partial(_columns, part=part)),
                log_probs=log_probs[:, part],
                targets=targets.values[:, part],
                advantages=targets.advantages[:, part],
                weights=targets.weights[:, part],
                valid=batch.valid[:, part],
            )
        return
    rows = batch.valid.flatten().nonzero().squeeze(1)  # [N]
    order = rows[torch.randperm(len(rows)).to(rows.device)]
    # One gather for each array and pass, and minibatches that are views of the result: gathering each minibatch would
    # take as many operations as there are minibatches, and small ones cost as much as large ones. Observations can be
    # images, of which a second copy of the whole batch would be too much.
    small = [each(batch.actions, partial(_rows, rows=order)), each(batch.masks, partial(_rows, rows=order))]
    shuffled = [_rows(values, order) for values in (batch.starts, log_probs, *targets, batch.valid)]
    start = 0
    for part in order.tensor_split(min(count, len(order))) if len(order) else ():
        columns = slice(start, start := start + len(part))
        actions, masks = (each(components, partial(_columns, part=columns)) for components in small)
        starts, own_log_probs, values, advantages, weights, valid = (array[:, columns] for array in shuffled)
        yield Minibatch(
            observations=each(batch.observations, partial(_rows, rows=part)),
            initial_state=batch.initial_state.new_zeros((len(part), 0)),
            starts=starts,
            actions=actions,
            masks=masks,
            log_probs=own_log_probs,
            targets=values,
            advantages=advantages,
            weights=weights,
            valid=valid,
        )


def _columns(values: Tensor, part: Tensor | slice, rows: int | None = None) -> Tensor:
    return values[:rows, part]


def _rows(values: Tensor, rows: Tensor) -> Tensor:
    """Return rows of [T, B, ...] by their numbers in T x B, as [1, N, ...]."""
    return values.flatten(0, 1)[rows].unsqueeze(0)
