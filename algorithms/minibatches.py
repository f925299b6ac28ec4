"""Minibatches of a batch, with targets that are computed once for all passes. Pure functions."""

from collections.abc import Iterator
from dataclasses import dataclass

import torch
from torch import Tensor

from daedalus.algorithms.batch import Batch
from daedalus.algorithms.returns import Targets


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Minibatch:
    """Part of a batch that one update learns from: R rows of B environments.

    R is T for a policy with memory. Without memory R is 1, and B counts single rows.
    """

    observations: Tensor  # [R, B, *stacked_shape]
    initial_state: Tensor  # [B, S]
    starts: Tensor  # [R, B] bool
    actions: Tensor  # [R, B] int64
    log_probs: Tensor  # [R, B], log pi(a_t | s_t) before the first update of the batch
    targets: Tensor  # [R, B], value targets
    advantages: Tensor  # [R, B]
    valid: Tensor  # [R, B] float32


def minibatches(batch: Batch, log_probs: Tensor, targets: Targets, count: int) -> Iterator[Minibatch]:
    """Yield one shuffled pass over a batch as `count` minibatches of nearly equal size.

    With memory, a batch is split by environment, because the memory learns from consecutive rows. Without memory, it
    is split into single rows, and reset rows are omitted. A batch with fewer parts than `count` has empty minibatches.
    `log_probs` [T, B] is log pi(a_t | s_t) before the first update of the batch.
    """
    if batch.initial_state.shape[1]:
        order = torch.randperm(batch.actions.shape[1]).to(batch.actions.device)
        for part in order.tensor_split(count):
            yield Minibatch(
                observations=batch.observations[:-1, part],
                initial_state=batch.initial_state[part],
                starts=batch.starts[:-1, part],
                actions=batch.actions[:, part],
                log_probs=log_probs[:, part],
                targets=targets.values[:, part],
                advantages=targets.advantages[:, part],
                valid=batch.valid[:, part],
            )
        return
    rows = batch.valid.flatten().nonzero().squeeze(1)  # [N]
    order = rows[torch.randperm(len(rows)).to(rows.device)]
    observations = batch.observations[:-1].flatten(0, 1)

    def select(values: Tensor, part: Tensor) -> Tensor:
        return values.flatten(0, 1)[part].unsqueeze(0)

    for part in order.tensor_split(count):
        yield Minibatch(
            observations=observations[part].unsqueeze(0),
            initial_state=batch.initial_state.new_zeros((len(part), 0)),
            starts=select(batch.starts[:-1], part),
            actions=select(batch.actions, part),
            log_probs=select(log_probs, part),
            targets=select(targets.values, part),
            advantages=select(targets.advantages, part),
            valid=select(batch.valid, part),
        )
