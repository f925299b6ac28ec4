"""How many updates a batch makes. The intake must know it before the learner computes them."""

from collections.abc import Sequence

import numpy as np

from daedalus.protocol.messages import Rollout
from daedalus.protocol.spec import TrainingSpec


def updates_of(training: TrainingSpec, rollouts: Sequence[Rollout], *, memory: bool) -> int:
    """Return the number of policy versions that a batch of these rollouts makes; `memory`: the policy has one."""
    if memory:
        return training.updates_from(sum(rollout.environments for rollout in rollouts))
    return training.updates_from(sum(int(np.count_nonzero(rollout.valid)) for rollout in rollouts))
