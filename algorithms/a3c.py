"""A3C: asynchronous advantage actor-critic, from rollouts.

In the paper a worker computes the gradient at the weights that chose the actions, and only the application of the
gradient is delayed. Here the learner computes the gradient at its newest weights, from a rollout of older weights, and
does not correct for the policy lag.
"""

from daedalus.algorithms.policy_gradient import PolicyGradient
from daedalus.protocol.algorithms import ALGORITHMS


class A3c(PolicyGradient):
    """Mnih et al. (2016), algorithm S3, with the gradient computed by the learner (see the top of this file)."""

    record = ALGORITHMS["a3c"]
