"""Greedy policies over discrete actions, by the values of the actions."""

import torch
from torch import Tensor

from daedalus.policy.network.distributions.distribution import Distribution
from daedalus.protocol.spaces import DiscreteSpace

_NEVER = -1e30  # log-probability of an action that is not chosen: finite, and its exponential is 0


class Greedy(Distribution):
    """The choice with the largest value Q(s, a); the parameters are the values of all choices of one variable.

    Without exploration (policy/network/exploration.py) its log-probability is 0 for that choice. It has no gradient.
    """

    def __init__(self, space: DiscreteSpace) -> None:
        super().__init__()
        self.parameter_count = space.choices

    def sample(self, parameters: Tensor, uniform: Tensor, normal: Tensor) -> Tensor:
        """See Distribution. Needs no noise."""
        return parameters.argmax(-1, keepdim=True)

    def log_prob(self, parameters: Tensor, actions: Tensor) -> Tensor:
        """See Distribution: 0 for the greedy action, and -1e30 for all others."""
        chosen = parameters.argmax(-1, keepdim=True) == actions
        return torch.where(chosen, 0.0, _NEVER).sum(-1)

    def entropy(self, parameters: Tensor) -> Tensor:
        """See Distribution: 0."""
        return parameters.new_zeros(parameters.shape[:-1])
