"""Gaussian policies over continuous actions, plain and squashed into bounds."""

import math

import torch
from torch import Tensor, nn
from torch.nn.functional import softplus

from daedalus.policy.network.distributions.bounding import bounded
from daedalus.policy.network.distributions.distribution import Distribution, expectation
from daedalus.protocol.spaces import ContinuousSpace

_LOG_STD_RANGE = (-5.0, 2.0)  # keeps densities and gradients finite
_HALF_LOG_2_PI = 0.5 * math.log(2.0 * math.pi)
_LARGEST = 1.0 - 1e-6  # a squashed action is at most so far from 0: beyond it float32 has too few digits left
_FREE_MEAN, _LARGEST_MEAN = 4.0, 6.0  # of a squashed action: means up to the first are as the head computes them
_QUADRATURE_POINTS = 16


class Gaussian(Distribution):
    """D independent normal distributions N(mu(s), sigma^2).

    The head computes the means. log sigma is learned, and does not depend on the observation unless
    `state_dependent`: then the head computes it too, relative to the learned one.
    """

    def __init__(self, space: ContinuousSpace, *, initial_std: float, state_dependent: bool) -> None:
        super().__init__()
        self._size, self._state_dependent = space.size, state_dependent
        self.parameter_count = 2 * space.size if state_dependent else space.size
        self.normal_count = space.size
        self.log_std = nn.Parameter(torch.full((space.size,), math.log(initial_std)))

    def sample(self, parameters: Tensor, uniform: Tensor, normal: Tensor) -> Tensor:
        """See Distribution: mu + sigma * normal."""
        mean, log_std = self._mean_and_log_std(parameters)
        return mean + log_std.exp() * normal

    def log_prob(self, parameters: Tensor, actions: Tensor) -> Tensor:
        """See Distribution: sum_d log N(a_d; mu_d, sigma_d^2)."""
        return _log_density(*self._mean_and_log_std(parameters), actions)

    def entropy(self, parameters: Tensor) -> Tensor:
        """See Distribution: sum_d (log sigma_d + log(2 pi e) / 2)."""
        return _entropy(*self._mean_and_log_std(parameters))

    def log_prob_and_entropy(self, parameters: Tensor, actions: Tensor) -> tuple[Tensor, Tensor]:
        """See Distribution."""
        mean, log_std = self._mean_and_log_std(parameters)
        return _log_density(mean, log_std, actions), _entropy(mean, log_std)

    def _mean_and_log_std(self, parameters: Tensor) -> tuple[Tensor, Tensor]:
        if not self._state_dependent:
            return parameters, bounded(self.log_std, *_LOG_STD_RANGE)
        mean, relative = parameters.split(self._size, -1)
        return mean, bounded(self.log_std + relative, *_LOG_STD_RANGE)


class SquashedGaussian(Gaussian):
    """tanh of a Gaussian: actions never leave their bounds (Haarnoja et al. 2018, appendix C).

    The means of the Gaussian approach +-6 beyond +-4, where an action is within 1e-3 of its bound. Samples around a
    larger mean would all be the largest action that float32 can tell from the bound, artanh(1 - 1e-6) = 7.25, whose
    density under that Gaussian is next to nothing although it is nearly always taken.
    """

    def sample(self, parameters: Tensor, uniform: Tensor, normal: Tensor) -> Tensor:
        """See Distribution: tanh(mu + sigma * normal)."""
        return super().sample(parameters, uniform, normal).tanh().clamp(-_LARGEST, _LARGEST)

    def log_prob(self, parameters: Tensor, actions: Tensor) -> Tensor:
        """See Distribution: log N(u) - sum_d log(1 - a_d^2), with u = artanh(a)."""
        actions = actions.clamp(-_LARGEST, _LARGEST)
        above, below = (1.0 + actions).log(), (1.0 - actions).log()
        return super().log_prob(parameters, 0.5 * (above - below)) - (above + below).sum(-1)

    def entropy(self, parameters: Tensor) -> Tensor:
        """See Distribution: H(u) + sum_d E[log(1 - tanh^2 u_d)], the expectation by Gauss-Hermite quadrature."""
        mean, log_std = self._mean_and_log_std(parameters)
        nodes, weights = (part.to(mean.device) for part in expectation(_QUADRATURE_POINTS))
        u = mean.unsqueeze(-1) + log_std.exp().unsqueeze(-1) * nodes  # [..., D, Q]
        log_slopes = 2.0 * (math.log(2.0) - u - softplus(-2.0 * u))  # log(1 - tanh^2 u), without overflow
        return super().entropy(parameters) + (log_slopes * weights).sum(-1).sum(-1)

    def log_prob_and_entropy(self, parameters: Tensor, actions: Tensor) -> tuple[Tensor, Tensor]:
        """See Distribution."""
        return self.log_prob(parameters, actions), self.entropy(parameters)

    def _mean_and_log_std(self, parameters: Tensor) -> tuple[Tensor, Tensor]:
        mean, log_std = super()._mean_and_log_std(parameters)
        inner = mean.clamp(-_FREE_MEAN, _FREE_MEAN)
        beyond = mean - inner
        # Not by tanh, whose gradient vanishes: a mean that is far beyond must come back.
        return inner + beyond / (1.0 + beyond.abs() / (_LARGEST_MEAN - _FREE_MEAN)), log_std


def _log_density(mean: Tensor, log_std: Tensor, actions: Tensor) -> Tensor:
    """Return sum_d log N(a_d; mu_d, sigma_d^2): mean and actions [..., D], log_std [D] or [..., D] -> [...]."""
    deviations = (actions - mean) * (-log_std).exp()
    return -0.5 * deviations.square().sum(-1) - (log_std + _HALF_LOG_2_PI).sum(-1)


def _entropy(mean: Tensor, log_std: Tensor) -> Tensor:
    """Return sum_d (log sigma_d + log(2 pi e) / 2), arguments as for `_log_density`."""
    return (log_std + (_HALF_LOG_2_PI + 0.5)).sum(-1).expand(mean.shape[:-1])
