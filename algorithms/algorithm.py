"""Interface of an algorithm to the code that computes its gradients."""

from collections.abc import Callable, Iterator
from typing import NamedTuple, Protocol

from torch import Tensor

from daedalus.algorithms.batch import Batch, Components
from daedalus.algorithms.diagnostics import FirstPass

# The network on R rows of B environments: normalised observations {name: [R, B, ...]}, state [B, S], starts [R, B] ->
# parameters of the action distributions [R, B, P], values [R, B].
Forward = Callable[[Components, Tensor, Tensor], tuple[Tensor, Tensor]]


class Losses(NamedTuple):
    """Terms of the loss of one update before they are weighted and summed, and the inputs of its metrics."""

    policy_loss: Tensor  # scalar
    entropies: Tensor  # [R, B], nats
    values: Tensor  # [R, B]
    targets: Tensor  # [R, B], value targets, without gradients
    shares: Tensor  # [R, B] float32, of the rows in a mean: 1/N for each of N valid rows, else 0
    clipped_fraction: Tensor  # scalar, share of rows whose probability ratio was clipped
    first_pass: FirstPass  # of the whole batch; the same object in all updates of a batch


class Algorithm(Protocol):
    """The mathematics of one algorithm. Its scheduling is in daedalus/protocol/algorithms.py."""

    def losses(self, batch: Batch, forward: Forward) -> Iterator[Losses]:
        """Yield the losses of each update of a batch, in order. The observations of the batch are normalised.

        The caller changes the parameters between two updates, so losses are computed only when the caller asks for
        the next update. The number of updates is that of `TrainingSpec.updates_from`.
        """
        ...
