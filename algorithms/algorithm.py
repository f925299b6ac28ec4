"""What an algorithm is to whoever computes its gradients, a learner or an actor."""

from collections.abc import Callable, Iterator
from typing import NamedTuple, Protocol

from torch import Tensor

from daedalus.algorithms.batch import Batch

# The network on R rows of B environments: observations [R, B, ...], state [B, S], starts [R, B] -> parameters of
# the action distributions [R, B, P], values [R, B].
Forward = Callable[[Tensor, Tensor, Tensor], tuple[Tensor, Tensor]]


class Losses(NamedTuple):
    """What one update descends, before the terms are weighted and summed; and what the metrics are made of."""

    policy_loss: Tensor  # scalar
    entropies: Tensor  # [R, B], nats
    values: Tensor  # [R, B]
    targets: Tensor  # [R, B], of the values; constants
    advantages: Tensor  # [R, B], constants
    valid: Tensor  # [R, B] float32, 1 or 0
    clipped_fraction: Tensor  # scalar, share of rows whose probability ratio was clipped


class Algorithm(Protocol):
    """The mathematics of one algorithm. Its scheduling is in daedalus/protocol/algorithms.py."""

    def losses(self, batch: Batch, forward: Forward) -> Iterator[Losses | None]:
        """Yield the losses of each update that a batch makes, in order.

        The caller changes the parameters between two of them, so each is computed when it is asked for. None stands
        for an update without a row to learn from: it makes a policy version and no step.
        """
        ...
