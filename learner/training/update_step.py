"""What follows the gradient of an update: clipping, a step of the optimiser, metrics; without reading a value."""

from collections.abc import Sequence

import torch
from torch import Tensor

from daedalus.algorithms.forward import FlatParameters
from daedalus.algorithms.gradients import Terms
from daedalus.learner.training.optimizers import build_optimizer
from daedalus.learner.training.update_metrics import UpdateMetrics
from daedalus.protocol.spec import TrainingSpec


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
