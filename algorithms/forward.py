"""The network as an algorithm uses it: forward passes, and the target network."""

import copy
from collections.abc import Iterable, Sequence
from contextlib import AbstractContextManager, nullcontext

import torch
from torch import Tensor, nn

from daedalus.policy.network.actor_critic import ActorCritic
from daedalus.policy.network.layers import Components


def flat_gradient(loss: Tensor, parameters: Sequence[nn.Parameter], out: Tensor | None = None) -> Tensor:
    """Return the gradients of a loss [P], in `out` if given; 0 for a parameter that it does not depend on."""
    gradients = torch.autograd.grad(loss, parameters, materialize_grads=True)
    return torch.cat([gradient.flatten() for gradient in gradients], out=out)


def forward_precision(device: str, *, is_mixed: bool) -> AbstractContextManager[object]:
    """Return a context for one forward pass: its cache of cast weights must not survive an update of the weights."""
    return torch.autocast(device, torch.bfloat16) if is_mixed else nullcontext()


class FlatParameters:
    """All parameters of a module as views into one vector, and their gradients as another.

    One vector replaces many small tensors: an optimiser step takes a few operations for any network, and the norm of
    the gradient takes one.
    """

    def __init__(self, parameters: Iterable[nn.Parameter]) -> None:
        self._parameters = parameters = list(parameters)
        self.values = torch.cat([parameter.detach().flatten() for parameter in parameters])  # [P]
        self.gradients = torch.zeros_like(self.values)  # [P]
        start = 0
        for parameter in parameters:
            end = start + parameter.numel()
            parameter.data = self.values[start:end].view_as(parameter)
            start = end

    def differentiated(self, loss: Tensor, out: Tensor | None = None) -> Tensor:
        """See `flat_gradient`."""
        return flat_gradient(loss, self._parameters, out)

    def clip_gradients(self, max_norm: float) -> Tensor:
        """Scale the gradients so that their norm is at most `max_norm`; return their norm before, a scalar.

        No value is read. Gradients whose norm is not finite stay without use.
        """
        norm = torch.linalg.vector_norm(self.gradients)
        self.gradients.mul_((max_norm / (norm + 1e-6)).clamp_(max=1.0))
        return norm


class Forward:
    """Forward passes of the network that is being learned, and of its target network if the algorithm has one."""

    def __init__(self, network: ActorCritic, learned: FlatParameters, *, has_target: bool, is_mixed: bool) -> None:
        """Construct both; the target network begins as a copy.

        Args:
          network: the network that is being learned.
          learned: its parameters that have gradients.
          has_target: whether there is a target network.
          is_mixed: whether forward passes compute in bfloat16.
        """
        self._network, self._learned, self._is_mixed = network, learned, is_mixed
        self._target = copy.deepcopy(network) if has_target else None
        self.target_values = learned.values[:0]  # [P]; [0] without a target network
        self.target_parameters: dict[str, Tensor] = {}  # views of them, by name
        if self._target is not None:
            named = {name: each for name, each in self._target.named_parameters() if each.requires_grad}
            self.target_values = FlatParameters(named.values()).values
            self.target_parameters = {name: each.detach() for name, each in named.items()}

    def __call__(self, observations: Components, state: Tensor, starts: Tensor) -> tuple[Tensor, Tensor]:
        """Compute R rows of B environments with the network.

        Args:
          observations: normalised, of each component [R, B, *stacked_shape].
          state: [B, S], the memory before row 0.
          starts: [R, B] bool, an episode starts with the row.

        Returns: parameters of the action distributions [R, B, P], or the action values; and values [R, B].
        """
        with self._precision(starts):
            return self._network.unroll(observations, state, starts)

    def policy(self, observations: Components, state: Tensor, starts: Tensor) -> tuple[Tensor, Tensor]:
        """Compute the policies alone; return their parameters [R, B, P] and the state after the last row [B, S]."""
        with self._precision(starts):
            return self._network.policy(observations, state, starts)

    def target(self, observations: Components, state: Tensor, starts: Tensor) -> tuple[Tensor, Tensor]:
        """Compute the same with the target network, without gradients.

        Raises ValueError if the record of the algorithm has no `target_network`.
        """
        target = self._checked_target()
        with torch.no_grad(), self._precision(starts):
            return target.unroll(observations, state, starts)

    def update_target(self, share: float = 1.0) -> None:
        """Move the target network's parameters by a share of the way to the network's: 1 makes both equal.

        Raises ValueError as `target`.
        """
        self._checked_target()
        if share == 1.0:
            self.target_values.copy_(self._learned.values)
        else:
            self.target_values.lerp_(self._learned.values, share)

    def _checked_target(self) -> ActorCritic:
        if self._target is None:
            raise ValueError("there is no target network: set target_network in the record of the algorithm")
        return self._target

    def _precision(self, starts: Tensor) -> AbstractContextManager[object]:
        return forward_precision(starts.device.type, is_mixed=self._is_mixed)
