"""Random actions that do not depend on the observation."""

import math

import torch
from torch import Tensor

from daedalus.policy.network.distributions.distribution import Distribution
from daedalus.protocol.spaces import ContinuousSpace

# Actions keep this distance from the bounds, where the densities of some distributions are 0 or infinite.
_LARGEST = 1.0 - 1e-4
_NEVER = -1e30


class Uniform(Distribution):
    """Uniform distribution over D bounded continuous actions, which are scaled to [-1, 1]. It has no parameters."""

    def __init__(self, space: ContinuousSpace) -> None:
        super().__init__()
        self.parameter_count = 0
        self.uniform_count = space.size
        self._log_density = -space.size * math.log(2.0 * _LARGEST)

    def sample(self, parameters: Tensor, uniform: Tensor, normal: Tensor) -> Tensor:
        """See Distribution."""
        return _LARGEST * (2.0 * uniform - 1.0)

    def log_prob(self, parameters: Tensor, actions: Tensor) -> Tensor:
        """See Distribution: -1e30 for actions that are never chosen."""
        outside = (actions.abs() > _LARGEST).any(-1)
        return torch.where(outside, _NEVER, self._log_density)
