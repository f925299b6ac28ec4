"""Gradients of the updates of a batch, at the current parameters of the network. The caller applies them."""

from collections.abc import Iterator
from typing import NamedTuple

import torch
from torch import Tensor

from daedalus.algorithms.algorithm import Losses
from daedalus.algorithms.batch import Batch, Components
from daedalus.algorithms.diagnostics import FirstPass
from daedalus.algorithms.flat_parameters import FlatParameters
from daedalus.algorithms.losses import explained_variance, masked_mean, value_loss
from daedalus.algorithms.own_algorithm import check_updates
from daedalus.algorithms.precision import autocast
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
    explained_variance: Tensor
    value_mean: Tensor
    advantage_std: Tensor
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
        self._first_pass: FirstPass | None = None  # of the newest batch
        if is_own(spec.algorithm):
            check_updates(spec, lambda batch: self.compute(batch, spec.entropy_bonus), spaces, network.state_size)
            self._first_pass = None

    def compute(self, batch: Batch, entropy_bonus: float) -> Iterator[Terms]:
        """Write the gradient of each update of a batch to `parameters.gradients`, and yield its loss terms.

        The caller applies the gradient before it asks for the next update.
        """
        for losses in self._algorithm.losses(batch, self._forward):
            value_term = value_loss(losses.values, losses.targets, losses.valid, self._spec.value_loss)
            entropy = masked_mean(losses.entropies, losses.valid)
            loss = losses.policy_loss + self._spec.value_coefficient * value_term - entropy_bonus * entropy
            self._first_pass = losses.first_pass
            self.parameters.gradients.zero_()
            loss.backward()
            yield _terms(losses, value_term, entropy)

    def take_first_pass(self) -> FirstPass | None:
        """Return the first pass of the newest batch, once; None without a batch since the last call.

        It is valid until the memory of the batch is used for the next one.
        """
        first_pass, self._first_pass = self._first_pass, None
        return first_pass

    def _forward(self, observations: Components, state: Tensor, starts: Tensor) -> tuple[Tensor, Tensor]:
        with autocast(self._spec.precision, starts.device, self._network.convolutional):
            return self._network(observations, state, starts)


@torch.no_grad()
def _terms(losses: Losses, value_term: Tensor, entropy: Tensor) -> Terms:
    centred = losses.advantages - masked_mean(losses.advantages, losses.valid)
    return Terms(
        policy_loss=losses.policy_loss.detach(),
        value_loss=value_term.detach(),
        entropy=entropy.detach(),
        explained_variance=explained_variance(losses.values, losses.targets, losses.valid),
        value_mean=masked_mean(losses.values, losses.valid),
        advantage_std=masked_mean(centred.square(), losses.valid).sqrt(),
        clipped_fraction=losses.values.new_zeros(()) if losses.clipped_fraction is None else losses.clipped_fraction,
    )
