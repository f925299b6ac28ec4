"""Exploration of actors: with probability epsilon a random legal action in place of the policy's."""

from collections.abc import Mapping

import torch
from torch import Tensor, nn

from daedalus.policy.network.action_distribution import ActionDistribution
from daedalus.policy.network.distributions import Categorical, Distribution, Uniform, without_illegal
from daedalus.policy.network.layers import Components
from daedalus.policy.user_modules import NetworkError
from daedalus.protocol.spaces import DiscreteSpace, Spaces

ANNEALING = "exploration.annealing"  # name of the parameter in a network

_NEVER = -1e30  # logarithm of the weight of a part that is never chosen from
_SMALLEST = 1e-30  # argument of a logarithm


class Exploration(nn.Module):
    """The behaviour policy mu = (1 - epsilon) pi + epsilon u, u being uniform over the legal actions.

    A whole action is random, or is the policy's. Each actor has its own final epsilon. `annealing` falls from 1 to 0
    while epsilon falls from 1 to that number: it is a parameter without a gradient, so that snapshots bring it.
    """

    def __init__(self, spaces: Spaces) -> None:
        """Raise NetworkError if an action has no bounds to choose within."""
        super().__init__()
        self._masked = frozenset(spaces.masks)
        self._uniform: dict[str, Distribution] = {}
        for name, space in spaces.actions.items():
            if isinstance(space, DiscreteSpace):
                self._uniform[name] = Categorical(space)
            elif space.bounded:
                self._uniform[name] = Uniform(space)
            else:
                raise NetworkError(
                    f"training.exploration takes random actions, but {name!r} is {space} and has no bounds to choose "
                    "within: leave training.exploration unset"
                )
        self.annealing = nn.Parameter(torch.zeros(1), requires_grad=False)
        self.uniform_count = 1 + sum(part.uniform_count for part in self._uniform.values())

    @torch.no_grad()
    def set_annealing(self, value: float) -> None:
        """Set how much of epsilon's way from 1 to its final values is left: 1 to 0.

        Compact snapshots have the precision of bfloat16: the value is rounded to it.
        """
        self.annealing.fill_(value)
        self.annealing.copy_(self.annealing.to(torch.bfloat16))

    def epsilon(self, final: Tensor) -> Tensor:
        """Return epsilon [N] of rows whose final epsilon is [N, 1]; 0 where that is 0: an evaluation never explores."""
        now = final + (1.0 - final) * self.annealing
        return torch.where(final > 0.0, now, 0.0).squeeze(-1)

    def act(
        self,
        distribution: ActionDistribution,
        parameters: Tensor,
        uniform: Tensor,
        normal: Tensor,
        masks: Components,
        final: Tensor,
    ) -> tuple[Components, Tensor]:
        """Choose one action for each row, and return the actions with log mu [N].

        Args:
          distribution, parameters, normal, masks: as for ActionDistribution.sample.
          uniform: [N, U + uniform_count]: the distribution's, then this module's.
          final: [N, 1], the final epsilon of the actor of each row.
        """
        own, extra = uniform[:, : -self.uniform_count], uniform[:, -self.uniform_count :]
        epsilon = self.epsilon(final)
        greedy = distribution.sample(parameters, own, normal, masks)
        explores = (extra[:, 0] < epsilon).unsqueeze(-1)
        at_random = self._sample(extra[:, 1:], masks)
        actions = {name: torch.where(explores, at_random[name], values) for name, values in greedy.items()}
        log_policy = distribution.log_prob(parameters, actions, masks)
        return actions, log_mixture(epsilon, log_policy, self.log_uniform(actions, masks))

    def log_uniform(self, actions: Components, masks: Mapping[str, Tensor]) -> Tensor:
        """Return log u(a | s): actions [..., D], masks [..., choices] -> [...]."""
        terms = [part.log_prob(self._logits(name, actions[name], masks), actions[name]) for name, part in self._parts()]
        return terms[0] if len(terms) == 1 else torch.stack(terms).sum(0)

    def _sample(self, uniform: Tensor, masks: Components) -> Components:
        noise = uniform.split([part.uniform_count for part in self._uniform.values()], -1)
        return {
            name: part.sample(self._logits(name, own, masks), own, own)
            for (name, part), own in zip(self._parts(), noise, strict=True)
        }

    def _parts(self) -> list[tuple[str, Distribution]]:
        return list(self._uniform.items())

    def _logits(self, name: str, like: Tensor, masks: Mapping[str, Tensor]) -> Tensor:
        """Return the parameters of a uniform distribution [..., P], for rows like those of `like` [..., X]."""
        # A sum, not `expand`: an exported program would keep the number of rows that it was traced with.
        logits = 0.0 * like[..., :1].to(torch.float32) + torch.zeros(
            self._uniform[name].parameter_count, device=like.device
        )
        return without_illegal(logits, masks[name]) if name in self._masked else logits


def log_mixture(epsilon: Tensor, log_policy: Tensor, log_uniform: Tensor) -> Tensor:
    """Return log((1 - epsilon) pi + epsilon u), all [N]; exactly log pi where epsilon is 0."""
    policy = _log(1.0 - epsilon) + log_policy
    uniform = _log(epsilon) + log_uniform
    larger = torch.maximum(policy, uniform)
    return larger + ((policy - larger).exp() + (uniform - larger).exp()).log()


def _log(weight: Tensor) -> Tensor:
    return torch.where(weight > 0.0, weight.clamp(min=_SMALLEST).log(), _NEVER)
