"""A skewed, bounded distribution whose inverse is closed."""

import math

import torch
from torch import Tensor
from torch.nn.functional import softplus

from daedalus.policy.network.distributions.distribution import Distribution
from daedalus.protocol.spaces import ContinuousSpace

_EDGE = 1e-5  # samples keep this distance from the bounds, where the density may be 0
_LARGEST = 1e3  # of both parameters: keeps densities finite
_EULER = 0.5772156649015329


class Kumaraswamy(Distribution):
    """D independent Kumaraswamy distributions on [-1, 1]: like Beta, and its inverse is closed. Kumaraswamy (1980).

        p(x) = a b x^(a-1) (1 - x^a)^(b-1) on [0, 1], with x = (action + 1) / 2
        x = (1 - (1 - u)^(1/b))^(1/a) for u uniform

    a and b are 1 + softplus of the head's outputs: above 1 the density has one peak and no pole. The greedy action is
    the median.
    """

    def __init__(self, space: ContinuousSpace) -> None:
        super().__init__()
        self._size = space.size
        self.parameter_count = 2 * space.size
        self.uniform_count = space.size

    def sample(self, parameters: Tensor, uniform: Tensor, normal: Tensor) -> Tensor:
        """See Distribution: by the inverse of the distribution function."""
        a, b = self._shapes(parameters)
        tail = ((1.0 - uniform).log() / b).exp()  # (1 - u)^(1/b)
        x = ((1.0 - tail).clamp(min=1e-30).log() / a).exp()
        return 2.0 * x.clamp(_EDGE, 1.0 - _EDGE) - 1.0

    def log_prob(self, parameters: Tensor, actions: Tensor) -> Tensor:
        """See Distribution: sum_d log p((a_d + 1) / 2) / 2, the half from scaling [0, 1] to [-1, 1]."""
        a, b = self._shapes(parameters)
        log_x = (0.5 * (actions + 1.0)).clamp(_EDGE, 1.0 - _EDGE).log()
        above = (1.0 - (a * log_x).exp()).clamp(min=1e-7).log()  # log(1 - x^a)
        return (a.log() + b.log() + (a - 1.0) * log_x + (b - 1.0) * above - math.log(2.0)).sum(-1)

    def entropy(self, parameters: Tensor) -> Tensor:
        """See Distribution: sum_d (1 - 1/b) + (1 - 1/a) H_b - log(a b) + log 2, H_b the harmonic number."""
        a, b = self._shapes(parameters)
        harmonic = torch.digamma(b + 1.0) + _EULER
        return (1.0 - 1.0 / b + (1.0 - 1.0 / a) * harmonic - a.log() - b.log() + math.log(2.0)).sum(-1)

    def _shapes(self, parameters: Tensor) -> tuple[Tensor, Tensor]:
        a, b = (1.0 + softplus(parameters)).clamp(max=_LARGEST).split(self._size, -1)
        return a, b
