"""What the network of a saved policy computes besides actions, such as values. Imports torch: actors never use it."""

from typing import NamedTuple

import numpy as np
import torch

from daedalus.policy.acting.program_check import PolicyError
from daedalus.policy.network.actor_critic import ActorCritic
from daedalus.policy.saving.saved_policy import SavedPolicy
from daedalus.policy.user_code import message_line
from daedalus.policy.user_modules import NetworkError, UserModules
from daedalus.protocol.spaces import DiscreteSpace


class ValueEstimator:
    """The critic of one checkpoint."""

    def __init__(self, policy: SavedPolicy, modules: UserModules) -> None:
        """Build the network. Raises PolicyError if the parameters do not fit it, or a module may not be imported."""
        spec, spaces = policy.spec, policy.spaces
        try:
            network = ActorCritic(spec.policy, spaces, modules, spec.training)
            given = {name: torch.from_numpy(values.copy()) for name, values in policy.weights.items()}
            network.load_state_dict(given, strict=False)
        except (NetworkError, RuntimeError) as error:
            raise PolicyError(message_line(error)) from None
        missing = dict(network.named_parameters()).keys() - given.keys()
        if missing:
            raise PolicyError(f"the checkpoint lacks the parameters {min(missing)!r}")
        self._network = network.eval().requires_grad_(False)
        self._discrete = {name for name, space in spaces.observations.items() if isinstance(space, DiscreteSpace)}
        # Of an algorithm of action values, the value of a state is that of its best action.
        self._is_known = network.value_head is not None or spec.training.record.heads == "action_values"

    def __call__(self, observations: dict[str, np.ndarray], state: np.ndarray) -> float | None:
        """Return the value of one observation, in the scale of the rewards that the learner sees; None if unknown.

        Args:
          observations: of each component [1, *stacked_shape].
          state: [1, S] float32, the policy's memory.
        """
        if not self._is_known:
            return None
        parameters, values = self._forward(observations, state)
        return float(parameters.max() if self._network.value_head is None else values[0, 0])

    def outputs(self, observations: dict[str, np.ndarray], masks: dict[str, np.ndarray]) -> "Outputs | None":
        """Return what the network says of N observations [N, *stacked_shape], each the first of an episode.

        None for a policy of action values, which has no distribution. `masks` [N, choices] bool are of masked actions.
        """
        if self._network.value_head is None:
            return None
        count = len(next(iter(observations.values())))
        parameters, values = self._forward(observations, np.zeros((count, self._network.state_size), np.float32))
        legal = {name: torch.from_numpy(mask.copy()) for name, mask in masks.items()}
        distribution = self._network.distribution
        probabilities = distribution.probabilities(parameters[0], legal)
        return Outputs(
            values[0].numpy(),
            distribution.entropy(parameters[0], legal).numpy(),
            {name: each.numpy() for name, each in probabilities.items()},
        )

    def _forward(self, observations: dict[str, np.ndarray], state: np.ndarray) -> tuple[torch.Tensor, torch.Tensor]:
        """Return the parameters of the distributions [1, N, P], and the values [1, N]."""
        row = {
            name: torch.from_numpy(values.astype(np.int64) if name in self._discrete else values.copy())[None]
            for name, values in observations.items()
        }
        return self._network(row, torch.from_numpy(state.copy()), torch.zeros((1, len(state)), dtype=torch.bool))


class Outputs(NamedTuple):
    """What a network says of N observations."""

    values: np.ndarray  # [N] float32, in the scale of the rewards that the learner sees
    entropies: np.ndarray  # [N] float32, nats
    probabilities: dict[str, np.ndarray]  # of each discrete action [N, D, A], of every choice of each variable
