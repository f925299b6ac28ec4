"""Which rollouts of a batch are at fault if the gradient of an update is not finite. Rare, so it may be slow."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch

from daedalus.algorithms.batch import BatchAssembler
from daedalus.algorithms.gradients import GradientComputer
from daedalus.protocol.messages import Rollout
from daedalus.protocol.spaces import ArraySpace


def rollouts_at_fault(
    gradients: GradientComputer, observation: ArraySpace, device: torch.device, rollouts: Sequence[Rollout]
) -> list[Rollout]:
    """Return the rollouts that have no finite gradient of their own at the present parameters.

    Return none if a rollout of zeros has no finite gradient either: then the parameters are at fault, and no sender.
    The gradients of the parameters are overwritten; the parameters are not changed.
    """

    def is_finite(rollout: Rollout) -> bool:
        batch = BatchAssembler(observation, device).join([rollout]).to(device)
        # All updates of the batch, because a minibatch has only some of its rows.
        return all(bool(gradients.parameters.gradients.norm().isfinite()) for _ in gradients.compute(batch, 0.0))

    if not is_finite(_of_zeros(rollouts[0])):
        return []
    return [rollout for rollout in rollouts if not is_finite(rollout)]


def _of_zeros(rollout: Rollout) -> Rollout:
    """Return a rollout of the same shapes whose numbers are 0."""
    names = ("frames", "initial_state", "behaviour_log_probs", "rewards")
    return replace(rollout, **{name: np.zeros_like(getattr(rollout, name)) for name in names})
