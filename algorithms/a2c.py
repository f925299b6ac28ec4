"""A2C: synchronous advantage actor-critic. Every live actor's rollout is of the newest policy version."""

from daedalus.algorithms.policy_gradient import PolicyGradient
from daedalus.algorithms.targets import uncorrected_targets
from daedalus.policy.network.distributions import ActionDistribution
from daedalus.protocol.spec import TrainingSpec


class A2c(PolicyGradient):
    """Mnih et al. (2016), algorithm S3, with its workers in step: needs no correction, since nothing lags."""

    def __init__(self, spec: TrainingSpec, distribution: ActionDistribution) -> None:
        super().__init__(spec, distribution, uncorrected_targets)
