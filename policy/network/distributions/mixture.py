"""Mixtures of Gaussians: policies with several separate preferred actions."""

import math

import torch
from torch import Tensor, nn

from daedalus.policy.network.distributions.bounding import bounded
from daedalus.policy.network.distributions.distribution import Distribution, expectation
from daedalus.protocol.spaces import ContinuousSpace

_LOG_STD_RANGE = (-5.0, 2.0)  # as for Gaussian
_HALF_LOG_2_PI = 0.5 * math.log(2.0 * math.pi)
_QUADRATURE_POINTS = 16


class GaussianMixture(Distribution):
    """D independent mixtures of K normal distributions: sum_k w_k(s) N(mu_k(s), sigma_k^2). Bishop (1994).

    The head computes the weights' logits and the means. sigma_k is learned, and does not depend on the observation.
    The greedy action is the mean of the most probable component.
    """

    def __init__(self, space: ContinuousSpace, *, initial_std: float, components: int) -> None:
        super().__init__()
        self._size, self._components = space.size, components
        self.parameter_count = 2 * space.size * components
        self.uniform_count = space.size * components  # to choose the component
        self.normal_count = space.size
        # Different means from the start: equal components would have equal gradients for ever.
        spread = torch.linspace(-0.5, 0.5, components) if components > 1 else torch.zeros(1)
        self.offsets = nn.Parameter(spread.repeat(space.size, 1))  # [D, K]
        self.log_std = nn.Parameter(torch.full((space.size, components), math.log(initial_std)))

    def sample(self, parameters: Tensor, uniform: Tensor, normal: Tensor) -> Tensor:
        """See Distribution. The component is chosen by the Gumbel-max trick."""
        log_weights, means, log_std = self._mixture(parameters)
        gumbel = -torch.log(-torch.log(uniform)).unflatten(-1, log_weights.shape[-2:])
        chosen = (log_weights + gumbel).argmax(-1, keepdim=True)  # [N, D, 1]
        mean = means.gather(-1, chosen).squeeze(-1)
        return mean + log_std.expand_as(means).gather(-1, chosen).squeeze(-1).exp() * normal

    def log_prob(self, parameters: Tensor, actions: Tensor) -> Tensor:
        """See Distribution: sum_d log sum_k w_dk N(a_d; mu_dk, sigma_dk^2)."""
        return _log_density(actions.unsqueeze(-1), *self._mixture(parameters)).sum(-1)

    def entropy(self, parameters: Tensor) -> Tensor:
        """See Distribution: - sum_d sum_k w_dk E_k[log p_d], the expectations by Gauss-Hermite quadrature."""
        log_weights, means, log_std = self._mixture(parameters)
        nodes, weights = (part.to(means.device) for part in expectation(_QUADRATURE_POINTS))
        points = means.unsqueeze(-1) + log_std.exp().unsqueeze(-1) * nodes  # [..., D, K, Q]
        every = (part.unsqueeze(-2).unsqueeze(-2) for part in (log_weights, means, log_std))  # [..., D, 1, 1, K]
        expected = (_log_density(points.unsqueeze(-1), *every) * weights).sum(-1)  # [..., D, K]
        return -(log_weights.exp() * expected).sum(-1).sum(-1)

    def _mixture(self, parameters: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return log w [..., D, K], mu [..., D, K] and log sigma [D, K]."""
        logits, means = parameters.unflatten(-1, (2, self._size, self._components)).unbind(-3)
        return logits.log_softmax(-1), means + self.offsets, bounded(self.log_std, *_LOG_STD_RANGE)


def _log_density(points: Tensor, log_weights: Tensor, means: Tensor, log_std: Tensor) -> Tensor:
    """Return log sum_k w_k N(x; mu_k, sigma_k^2), the last axis of every argument being k."""
    deviations = (points - means) * (-log_std).exp()
    return (log_weights - 0.5 * deviations.square() - log_std - _HALF_LOG_2_PI).logsumexp(-1)
