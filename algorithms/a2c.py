"""A2C: synchronous advantage actor-critic. All rollouts of a batch are from the newest policy version."""

from daedalus.algorithms.policy_gradient import PolicyGradient
from daedalus.algorithms.targets import uncorrected_targets
from daedalus.policy.network.distributions.joint import ActionDistribution
from daedalus.protocol.spec import TrainingSpec


class A2c(PolicyGradient):
    """Synchronous form of Mnih et al. (2016), algorithm S3. There is no policy lag, so no correction is needed."""

    def __init__(self, spec: TrainingSpec, distribution: ActionDistribution) -> None:
        super().__init__(spec, distribution, uncorrected_targets)
