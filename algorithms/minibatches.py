"""What appo learns from in one update: a part of a batch, with targets made once for all passes. Pure functions."""

from collections.abc import Iterator
from dataclasses import dataclass

import torch
from torch import Tensor

from daedalus.algorithms.batch import Batch
from daedalus.algorithms.returns import Targets


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Minibatch:
    """R rows of B environments; R is 1 where rows are shuffled one by one."""

    observations: Tensor  # [R, B, *stacked_shape]
    initial_state: Tensor  # [B, S]
    starts: Tensor  # [R, B] bool
    actions: Tensor  # [R, B] int64
    log_probs: Tensor  # [R, B], of the policy at the batch's start
    targets: Tensor  # [R, B], of the value
    advantages: Tensor  # [R, B]
    valid: Tensor  # [R, B] float32


def minibatches(batch: Batch, log_probs: Tensor, targets: Targets, count: int) -> Iterator[Minibatch]:
    """One pass over a batch in `count` parts of nearly equal size, shuffled; some are empty in a batch that small.

    A batch with memory is cut along its environments: rows in their order are what the memory learns from. Without,
    it is cut into single rows, and those that only reset are left out.
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

    def chosen(values: Tensor, part: Tensor) -> Tensor:
        return values.flatten(0, 1)[part].unsqueeze(0)

    for part in order.tensor_split(count):
        yield Minibatch(
            observations=observations[part].unsqueeze(0),
            initial_state=batch.initial_state.new_zeros((len(part), 0)),
            starts=chosen(batch.starts[:-1], part),
            actions=chosen(batch.actions, part),
            log_probs=chosen(log_probs, part),
            targets=chosen(targets.values, part),
            advantages=chosen(targets.advantages, part),
            valid=chosen(batch.valid, part),
        )
