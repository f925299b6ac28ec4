"""The two optimisers, over one flat vector of all parameters.

One vector instead of many small tensors: a step is a handful of operations whatever the network, the gradient's
norm is one, and a checkpoint is a vector for each statistic. (Torch's optimisers, as objects, also load its compiler
when they are first made, which takes as long as all of a CartPole run; as functions they do not.)
"""

from collections.abc import Iterable
from typing import Protocol

import torch
from torch import Tensor, nn
from torch.optim.adam import adam


class FlatParameters:
    """All parameters of a module as views into one vector, and their gradients as views into another."""

    def __init__(self, parameters: Iterable[nn.Parameter]) -> None:
        parameters = list(parameters)
        self.values = torch.cat([parameter.detach().flatten() for parameter in parameters])  # [P]
        self.gradients = torch.zeros_like(self.values)  # [P]
        start = 0
        for parameter in parameters:
            end = start + parameter.numel()
            parameter.data = self.values[start:end].view_as(parameter)
            parameter.grad = self.gradients[start:end].view_as(parameter)
            start = end

    def clip_gradients(self, max_norm: float) -> Tensor:
        """Scales the gradients so that their norm is at most `max_norm`; returns the norm they had."""
        norm = self.gradients.norm()
        self.gradients.mul_((max_norm / (norm + 1e-6)).clamp(max=1.0))
        return norm


class Optimizer(Protocol):
    """Turns a gradient into a step. Its statistics are tensors, to be saved and restored by name."""

    statistics: dict[str, Tensor]

    def step(self, values: Tensor, gradients: Tensor, learning_rate: float) -> None:
        """Moves `values` [P] in place."""
        ...


class Adam:
    """Kingma & Ba (2015), algorithm 1, with the usual decays of 0.9 and 0.999: torch's, all in one pass."""

    _FIRST, _SECOND = 0.9, 0.999

    def __init__(self, values: Tensor, epsilon: float) -> None:
        self._epsilon = epsilon
        self.statistics = {
            "mean": torch.zeros_like(values),
            "square": torch.zeros_like(values),
            "steps": torch.zeros((), device=values.device),  # float32: it stops at 2^24, where it has no say any more
        }

    def step(self, values: Tensor, gradients: Tensor, learning_rate: float) -> None:
        """See Optimizer."""
        adam(
            [values],
            [gradients],
            [self.statistics["mean"]],
            [self.statistics["square"]],
            [],
            [self.statistics["steps"]],
            fused=True,
            amsgrad=False,
            beta1=self._FIRST,
            beta2=self._SECOND,
            lr=learning_rate,
            weight_decay=0.0,
            eps=self._epsilon,
            maximize=False,
        )


class RmsProp:
    """RMSProp without momentum: g = a g + (1 - a) d^2, theta = theta - rate d / sqrt(g + epsilon).

    Mnih et al. (2016), equations S2 and S3. The statistics are the paper's shared ones by construction: there is
    one learner.
    """

    def __init__(self, values: Tensor, epsilon: float, decay: float) -> None:
        self._epsilon = epsilon
        self._decay = decay
        self.statistics = {"square": torch.zeros_like(values)}

    def step(self, values: Tensor, gradients: Tensor, learning_rate: float) -> None:
        """See Optimizer."""
        square = self.statistics["square"]
        square.mul_(self._decay).addcmul_(gradients, gradients, value=1.0 - self._decay)
        values.addcdiv_(gradients, square.add(self._epsilon).sqrt_(), value=-learning_rate)
