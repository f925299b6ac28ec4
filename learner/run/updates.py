"""How many updates a batch makes. The intake must know it before the learner computes them."""

from collections.abc import Sequence

from daedalus.protocol.spec import TrainingSpec
from daedalus.protocol.uploads import Rollout, Upload


def updates_of(training: TrainingSpec, uploads: Sequence[Upload], *, memory: bool) -> int:
    """Return the number of policy versions that a batch of these uploads makes; `memory`: the policy has one."""
    if memory:  # gradients make one, whatever their number
        return training.updates_from(sum(upload.environments for upload in uploads if isinstance(upload, Rollout)))
    return training.updates_from(sum(upload.env_steps for upload in uploads))
