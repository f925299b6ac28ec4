"""A3C: asynchronous advantage actor-critic, from rollouts.

In the paper a worker computes the gradient at the weights that acted, and only its application is late. Here the
learner computes it, at its newest weights, from a rollout of older ones: uncorrected for that lag.
"""

from daedalus.algorithms.policy_gradient import PolicyGradient
from daedalus.algorithms.targets import uncorrected_targets
from daedalus.policy.network.distributions import ActionDistribution
from daedalus.protocol.spec import TrainingSpec


class A3c(PolicyGradient):
    """Mnih et al. (2016), algorithm S3, with the difference that this file's header states."""

    def __init__(self, spec: TrainingSpec, distribution: ActionDistribution) -> None:
        super().__init__(spec, distribution, uncorrected_targets)
