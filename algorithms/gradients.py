"""Gradients of the updates of a batch, at the current parameters of the network. The caller applies them."""

from collections.abc import Iterator
from dataclasses import replace
from typing import NamedTuple

from torch import Tensor

from daedalus.algorithms.batch import Batch
from daedalus.algorithms.diagnostics import FirstPass
from daedalus.algorithms.flat_parameters import FlatParameters
from daedalus.algorithms.forward import Forward
from daedalus.algorithms.losses import mean, value_loss
from daedalus.algorithms.own_algorithm import check_updates
from daedalus.algorithms.precision import is_mixed
from daedalus.algorithms.registry import build_algorithm
from daedalus.policy.network.actor_critic import ActorCritic
from daedalus.policy.user_modules import NO_MODULES, UserModules
from daedalus.protocol.algorithms import is_own
from daedalus.protocol.spaces import Spaces
from daedalus.protocol.spec import TrainingSpec


class Terms(NamedTuple):
    """Loss terms and statistics of one update: scalars without gradients."""

    policy_loss: Tensor
    value_loss: Tensor
    entropy: Tensor
    clipped_fraction: Tensor


class GradientComputer:
    """Gradient computation of one algorithm for one network."""

    def __init__(
        self, spec: TrainingSpec, network: ActorCritic, spaces: Spaces, modules: UserModules = NO_MODULES
    ) -> None:
        """Raise AlgorithmError if the user's own algorithm cannot be used; `modules` may be imported for it."""
        self._spec, self._network = spec, network
        self._algorithm = build_algorithm(spec, network.distribution, modules)
        self.parameters = FlatParameters(network.learned_parameters())
        self.forward = Forward(
            network,
            self.parameters,
            has_target=self._algorithm.record.target_network,
            is_mixed=is_mixed(spec.precision, self.parameters.values.device, network.convolutional),
        )
        self._first_pass: FirstPass | None = None  # of the newest batch
        if is_own(spec.algorithm):
            updates, state_size = (lambda batch: self.compute(batch, spec.entropy_bonus)), network.state_size
            check_updates(spec, updates, self._try_after_update, spaces, state_size)
            self._first_pass = None

    def compute(self, batch: Batch, entropy_bonus: float) -> Iterator[Terms]:
        """Write the gradient of each update of a batch to `parameters.gradients`, and yield its loss terms.

        The caller applies the gradient before it asks for the next update.
        """
        # The statistics of observations do not change within a batch: normalise once for all passes.
        batch = replace(batch, observations=self._network.normalizer(batch.observations))
        for losses in self._algorithm.losses(batch, self.forward):
            if not losses.values.shape == losses.targets.shape == losses.shares.shape:
                shapes = [tuple(each.shape) for each in (losses.values, losses.targets, losses.shares)]
                raise ValueError(f"the shapes of values, targets and shares differ: {shapes}")
            value_term = value_loss(losses.values, losses.targets, losses.shares, self._spec.value_loss)
            entropy = mean(losses.entropies, losses.shares)
            loss = losses.policy_loss + self._spec.value_coefficient * value_term - entropy_bonus * entropy
            self._first_pass = losses.first_pass
            self.parameters.differentiate(loss)
            clipped = entropy.new_zeros(()) if losses.clipped_fraction is None else losses.clipped_fraction
            yield Terms(losses.policy_loss.detach(), value_term.detach(), entropy.detach(), clipped)

    @property
    def first_pass(self) -> FirstPass | None:
        """The first pass of the newest batch, valid until the memory of the batch is used for the next one."""
        return self._first_pass

    def take_first_pass(self) -> FirstPass | None:
        """Return `first_pass`, once; None without a batch since the last call."""
        first_pass, self._first_pass = self._first_pass, None
        return first_pass

    def after_update(self, policy_version: int) -> None:
        """Let the algorithm do what follows an update, whose gradient the caller has applied."""
        self._algorithm.after_update(policy_version, self.forward)

    def _try_after_update(self) -> None:
        before = {name: values.clone() for name, values in self.statistics.items()}
        self.after_update(1)
        for name, values in self.statistics.items():
            values.copy_(before[name])

    @property
    def statistics(self) -> dict[str, Tensor]:
        """Tensors of the algorithm that a checkpoint saves, by name, and restores in place."""
        statistics = {f"algorithm/{name}": values for name, values in self._algorithm.statistics.items()}
        if self._algorithm.record.target_network:
            statistics["target_network"] = self.forward.target_values
        return statistics
