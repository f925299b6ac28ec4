"""A3C: asynchronous advantage actor-critic.

In the paper a worker computes the gradient at the weights that chose the actions, and only the application of the
gradient is delayed. So it is with `collection.upload = "gradients"`. With rollouts, the learner computes the gradient
at its newest weights, from a rollout of older weights, and does not correct for the policy lag.
"""

from daedalus.algorithms.policy_gradient import PolicyGradient
from daedalus.protocol.algorithms import ALGORITHMS


class A3c(PolicyGradient):
    """Mnih et al. (2016), algorithm S3 (see the top of this file for who computes the gradient)."""

    record = ALGORITHMS["a3c"]
