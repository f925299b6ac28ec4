"""Which rollouts of a batch are at fault if the gradient of an update is not finite. Rare, so it may be slow."""

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from daedalus.algorithms.batch import Batch
from daedalus.algorithms.gradients import GradientComputer
from daedalus.protocol.uploads import Rollout


def rollouts_at_fault(
    gradients: GradientComputer, joined: Callable[[Sequence[Rollout]], Batch], rollouts: Sequence[Rollout]
) -> list[Rollout]:
    """Return the rollouts that have no finite gradient of their own at the present parameters.

    Return none if a rollout of zeros has no finite gradient either: then the parameters are at fault, and no sender.
    The gradients of the parameters are overwritten; the parameters are not changed.

    Args:
      gradients: computes the gradients of a batch.
      joined: returns the batch of rollouts, as the updates have it.
      rollouts: the rollouts of the batch.
    """

    def is_finite(rollout: Rollout) -> bool:
        # All updates of the batch, because a minibatch has only some of its rows.
        updates = gradients.compute(joined([rollout]), 0.0)
        return all(bool(gradients.parameters.gradients.norm().isfinite()) for _ in updates)

    if not is_finite(_of_zeros(rollouts[0])):
        return []
    return [rollout for rollout in rollouts if not is_finite(rollout)]


def _of_zeros(rollout: Rollout) -> Rollout:
    """Return a rollout of the same shapes whose numbers are 0."""
    names = ("initial_state", "behaviour_log_probs", "rewards")
    arrays = {name: np.zeros_like(getattr(rollout, name)) for name in names}
    frames = {name: np.zeros_like(values) for name, values in rollout.frames.items()}
    continuous = {name: values for name, values in rollout.actions.items() if values.dtype == np.float32}
    actions = rollout.actions | {name: np.zeros_like(values) for name, values in continuous.items()}
    return replace(rollout, **arrays, frames=frames, actions=actions)
