"""A skewed, bounded distribution whose inverse is closed."""

import math

import torch
from numpy.polynomial.legendre import leggauss
from torch import Tensor
from torch.nn.functional import softplus

from daedalus.policy.network.distributions.bounding import bounded
from daedalus.policy.network.distributions.distribution import Distribution
from daedalus.protocol.spaces import ContinuousSpace

_EDGE = 1e-5  # samples keep this distance from the bounds, where the density may be 0
_LARGEST = 1e3  # of both parameters: keeps densities finite
_EULER = 0.5772156649015329
_TINY = 1e-30  # keeps logarithms finite
_QUADRATURE_POINTS = 8


class Kumaraswamy(Distribution):
    """D independent Kumaraswamy distributions on [-1, 1]: like Beta, and its inverse is closed. Kumaraswamy (1980).

        p(x) = a b x^(a-1) (1 - x^a)^(b-1) on [0, 1], with x = (action + 1) / 2
        x = (1 - (1 - u)^(1/b))^(1/a) for u uniform

    a and b are 1 + softplus of the head's outputs: above 1 the density has one peak and no pole. The greedy action is
    the mean. The median is a worse choice where the density is skewed: a car that was trained with samples drove far
    worse with it (docs/results.md, "What was tried").
    """

    def __init__(self, space: ContinuousSpace) -> None:
        super().__init__()
        self._size = space.size
        self.parameter_count = 2 * space.size
        self.uniform_count = space.size

    def sample(self, parameters: Tensor, uniform: Tensor, normal: Tensor) -> Tensor:
        """See Distribution: by the inverse of the distribution function.

        The noise is shifted, modulo 1, so that 0.5 gives the mean. A shifted uniform number is uniform, too.
        """
        a, b = self._shapes(parameters)
        shifted = uniform + _probability_below(_mean(a, b), a, b) - 0.5
        x = _quantile(shifted - shifted.floor(), a, b)
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
        a, b = bounded(1.0 + softplus(parameters), 1.0, _LARGEST).split(self._size, -1)
        return a, b


def _quantile(u: Tensor, a: Tensor, b: Tensor) -> Tensor:
    """Return the x in [0, 1] below which the probability is u: (1 - (1 - u)^(1/b))^(1/a)."""
    tail = ((1.0 - u).clamp(min=_TINY).log() / b).exp()  # (1 - u)^(1/b)
    return ((1.0 - tail).clamp(min=_TINY).log() / a).exp()


def _probability_below(x: Tensor, a: Tensor, b: Tensor) -> Tensor:
    """Return the probability of values below x: 1 - (1 - x^a)^b."""
    above = 1.0 - (a * x.clamp(min=_TINY).log()).exp()
    return 1.0 - (b * above.clamp(min=_TINY).log()).exp()


def _mean(a: Tensor, b: Tensor) -> Tensor:
    """Return the mean of x: the integral of the quantiles, by Gauss-Legendre quadrature.

    The closed form needs the gamma function, which ONNX does not have.
    """
    nodes, weights = (torch.tensor(each, dtype=a.dtype, device=a.device) / 2.0 for each in leggauss(_QUADRATURE_POINTS))
    return (_quantile(nodes + 0.5, a.unsqueeze(-1), b.unsqueeze(-1)) * weights).sum(-1)
