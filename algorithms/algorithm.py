"""Interface of an algorithm: what it needs of network and actors, the losses of a batch, what follows an update.

docs/guides/algorithm.md shows how to add one.
"""

from collections.abc import Callable, Iterator, Mapping
from types import MappingProxyType
from typing import ClassVar, NamedTuple

from torch import Tensor

from daedalus.algorithms.batch import Batch, Pass
from daedalus.algorithms.diagnostics import FirstPass
from daedalus.algorithms.forward import Forward
from daedalus.algorithms.minibatches import Minibatch
from daedalus.policy.network.action_distribution import ActionDistribution
from daedalus.protocol.algorithms import AlgorithmRecord
from daedalus.protocol.spec import LossSpec

__all__ = ["Algorithm", "Forward", "Losses", "MinibatchLosses"]


class Losses(NamedTuple):
    """Terms of the loss of one update before they are weighted and summed, and the inputs of its metrics.

    The loss of the update is policy_loss + value_coefficient * L(values, targets) - entropy_bonus * mean(entropies),
    where L is `training.value_loss`, or the given `value_loss`, and both means are over the valid rows.
    """

    policy_loss: Tensor  # scalar
    entropies: Tensor  # [R, B], nats
    values: Tensor  # [R, B]; for action values those of the actions that were taken
    targets: Tensor  # [R, B], value targets, without gradients
    shares: Tensor  # [R, B] float32, of the rows in a mean: 1/N for each of N valid rows, else 0
    clipped_fraction: Tensor | None = None  # scalar, share of rows whose probability ratio was clipped; None: no clip
    first_pass: FirstPass | None = None  # of the whole batch, for its diagnostics; the same object in all updates
    value_loss: Tensor | None = None  # scalar; None: the mean of `training.value_loss` of values and targets


class MinibatchLosses(NamedTuple):
    """The losses of one update as a function of a minibatch, for the caller to compute.

    The function must do the same operations for all minibatches of the same shapes, because the caller may record them
    (algorithms/recording.py), which makes the updates of a small network more than twice as fast. It must be the same
    object in all updates, or a method of one.
    """

    function: Callable[[Minibatch, Forward], Losses]  # whose `first_pass` is None
    minibatch: Minibatch
    first_pass: FirstPass | None = None  # as that of Losses


class Algorithm:
    """Base class of all algorithms.

    A class of its own derives from it, sets `record` and defines `losses`. The learner constructs it once.
    """

    # The heads, the schedule of the updates, how actors explore.
    record: ClassVar[AlgorithmRecord] = AlgorithmRecord()
    # Tensors that change in `after_update`: a checkpoint saves them by name, and restores them in place.
    statistics: Mapping[str, Tensor] = MappingProxyType({})

    def __init__(self, spec: LossSpec, distribution: ActionDistribution) -> None:
        """Construct the algorithm.

        Args:
          spec: settings of the training.
          distribution: distributions of the actions of the policy.

        The entries of `training.algorithm_kwargs` follow as keyword arguments.
        """
        self.spec, self.distribution = spec, distribution

    def losses(self, batch: Batch, forward: Forward) -> Iterator[Losses | MinibatchLosses]:
        """Yield the losses of each update of a batch, in order. The observations of the batch are normalised.

        The caller changes the parameters between two updates, so losses are computed only when the caller asks for
        the next update. The number of updates is that of `LossSpec.updates_from`.

        Args:
          batch: T rows of B environments. `batch.observations`, `batch.initial_state` and `batch.starts` are the
            arguments of `forward`, and have T+1 rows; the last row only bootstraps.
          forward: the network.
        """
        raise NotImplementedError

    def drawn(self, valid: Tensor, *, has_memory: bool) -> list[Pass]:
        """Return what is random in the updates of a batch, drawn on the CPU: `batch.passes` of `losses`.

        Args:
          valid: [T, B] float32 on the CPU, 1 for the rows to learn from.
          has_memory: whether the policy has a memory.
        """
        return []

    def after_update(self, policy_version: int, forward: Forward) -> None:
        """Do what follows an update, such as changing the target network. Only the learner calls this method.

        Args:
          policy_version: version of the new weights, from 1. Versions for which `losses` made no update are skipped.
          forward: the network, with its new parameters.
        """
