"""Adam and RMSProp over one flat vector of all parameters (daedalus/algorithms/forward.py).

A checkpoint holds one vector for each statistic. This file calls the kernel of torch's optimiser, because the first
construction of a torch optimiser class imports torch's compiler, which takes as long as a whole CartPole run, and its
function `adam` takes twice as long as the kernel for a small network.
"""

from typing import Protocol

import torch
from torch import Tensor

from daedalus.protocol.spec import TrainingSpec


class Optimizer(Protocol):
    """Interface of an optimiser. Its statistics are tensors that a checkpoint saves and restores by name."""

    statistics: dict[str, Tensor]

    def step(self, values: Tensor, gradients: Tensor, learning_rate: Tensor, skipped: Tensor) -> None:
        """Update `values` [P] in place, by one step along `gradients` [P]. No value is read on the CPU.

        Args:
          values, gradients: on one device, as all arguments.
          learning_rate: scalar, float32.
          skipped: scalar, float32; if it is 1, values and statistics stay as they are, and 0 otherwise.
        """
        ...


class Adam:
    """Adam: Kingma & Ba (2015), algorithm 1, with decays of 0.9 and 0.999. Uses torch's fused kernel."""

    _FIRST, _SECOND = 0.9, 0.999

    def __init__(self, values: Tensor, epsilon: float) -> None:
        self._epsilon = epsilon
        self.statistics = {
            "mean": torch.zeros_like(values),
            "square": torch.zeros_like(values),
            "steps": torch.zeros((), device=values.device),  # float32: stops at 2^24, where the bias correction is 1
        }

    def step(self, values: Tensor, gradients: Tensor, learning_rate: Tensor, skipped: Tensor) -> None:
        """See Optimizer."""
        statistics = self.statistics
        statistics["steps"].add_(1.0).sub_(skipped)
        torch._fused_adam_(  # pyright: ignore[reportPrivateImportUsage]
            [values],
            [gradients],
            [statistics["mean"]],
            [statistics["square"]],
            [],
            [statistics["steps"]],
            lr=learning_rate,
            beta1=self._FIRST,
            beta2=self._SECOND,
            weight_decay=0.0,
            eps=self._epsilon,
            amsgrad=False,
            maximize=False,
            found_inf=skipped,
        )


class RmsProp:
    """RMSProp without momentum: g = a g + (1 - a) d^2, theta = theta - rate d / sqrt(g + epsilon).

    Mnih et al. (2016), equations S2 and S3. The statistics are the paper's shared ones by construction: there is
    only one learner.
    """

    def __init__(self, values: Tensor, epsilon: float, decay: float) -> None:
        self._epsilon = epsilon
        self._decay = decay
        self.statistics = {"square": torch.zeros_like(values)}

    def step(self, values: Tensor, gradients: Tensor, learning_rate: Tensor, skipped: Tensor) -> None:
        """See Optimizer."""
        square, skips = self.statistics["square"], skipped > 0.0
        following = (square * self._decay).addcmul_(gradients, gradients, value=1.0 - self._decay)
        moved = values.addcdiv(gradients * -learning_rate, following.add(self._epsilon).sqrt_())
        torch.where(skips, square, following, out=square)
        torch.where(skips, values, moved, out=values)


def build_optimizer(spec: TrainingSpec, values: Tensor) -> Optimizer:
    """Return the optimiser named by `spec.optimizer`, for a vector of parameters [P]."""
    if spec.optimizer == "adam":
        return Adam(values, spec.optimizer_epsilon)
    return RmsProp(values, spec.optimizer_epsilon, spec.rmsprop_decay)
