"""Adam and RMSProp over one flat vector of all parameters (daedalus/algorithms/forward.py), and the steps of an update.

A checkpoint holds one vector for each statistic. This file calls the kernel of torch's optimiser, because the first
construction of a torch optimiser class imports torch's compiler, which takes as long as a whole CartPole run, and its
function `adam` takes twice as long as the kernel for a small network.
"""

from collections.abc import Sequence
from typing import Protocol

import torch
from torch import Tensor

from daedalus.algorithms.forward import FlatParameters
from daedalus.algorithms.gradients import Terms
from daedalus.algorithms.sac import FIRST_DECAY
from daedalus.learner.training.update_metrics import UpdateMetrics
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
    """Adam: Kingma & Ba (2015), algorithm 1, with decays of 0.9, or another, and 0.999. Uses torch's fused kernel."""

    _SECOND = 0.999

    def __init__(self, values: Tensor, epsilon: float, first_decay: float = 0.9) -> None:
        self._epsilon, self._first = epsilon, first_decay
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
            beta1=self._first,
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
        if spec.record.replay:
            return Adam(values, spec.optimizer_epsilon, FIRST_DECAY)
        return Adam(values, spec.optimizer_epsilon)
    return RmsProp(values, spec.optimizer_epsilon, spec.rmsprop_decay)


class UpdateStep:
    """Steps of the optimiser along the gradients of a batch, until one is not finite: all from there on are skipped.

    A step along a gradient that is not finite would set all parameters to nan for the rest of the run. Whether there
    was one is read once after a batch, because a GPU would have to finish each update before the next is launched.
    """

    def __init__(self, spec: TrainingSpec, parameters: FlatParameters, metrics: UpdateMetrics) -> None:
        self._parameters, self._metrics, self._max_norm = parameters, metrics, spec.max_gradient_norm
        self.optimizer = build_optimizer(spec, parameters.values)
        self._rate = parameters.values.new_zeros(())
        # Whether a gradient of the batch was not finite, 1 or 0, and the number of updates that were made of the batch.
        self._outcome = parameters.values.new_zeros(2)
        self._skips, self._made = self._outcome.unbind()
        self._sound = parameters.values.new_zeros(())
        self._metrics_before = torch.zeros_like(metrics.update_sums)
        self.changed: Sequence[Tensor] = [self._sound, self._skips, self._made, metrics.update_sums]

    def begin(self, learning_rate: float) -> None:
        """Begin with a batch, or with what is left of it."""
        self._rate.fill_(learning_rate)
        self._outcome.zero_()
        self._sound.zero_()
        self._metrics_before.copy_(self._metrics.update_sums)

    def clip(self, terms: Terms) -> None:
        """Clip the gradient in place, and add the metrics of its update."""
        norm = self._parameters.clip_gradients(self._max_norm)
        self._sound.addcmul_(norm, self._sound)  # 0 times an infinity, or nan, is nan: from then on it stays nan
        torch.ne(self._sound, 0.0, out=self._skips)
        self._made.add_(1.0).sub_(self._skips)
        self._metrics.add_update(terms, norm)

    def apply(self) -> None:
        """Make an update with the gradient in place."""
        self.optimizer.step(self._parameters.values, self._parameters.gradients, self._rate, self._skips)

    @property
    def has_failed(self) -> bool:
        """Whether a gradient of the batch was not finite. Waits for the device."""
        return bool(self._skips)

    def end(self) -> tuple[int, bool]:
        """Return how many updates were made of the batch, and whether a gradient was not finite. Waits for the device.

        If it was not, the metrics of the updates do not count.
        """
        failed, made = self._outcome.tolist()
        if failed:
            self._metrics.update_sums.copy_(self._metrics_before)
        else:
            self._metrics.count_updates(int(made))
        return int(made), failed > 0.0
