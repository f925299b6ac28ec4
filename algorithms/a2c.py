"""A2C: synchronous advantage actor-critic. All rollouts of a batch are from the newest policy version."""

from daedalus.algorithms.policy_gradient import PolicyGradient
from daedalus.protocol.algorithms import ALGORITHMS


class A2c(PolicyGradient):
    """Synchronous form of Mnih et al. (2016), algorithm S3. There is no policy lag, so no correction is needed."""

    record = ALGORITHMS["a2c"]
