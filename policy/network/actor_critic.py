"""The actor-critic network, built from its specification. Needs torch: actors do not import this file."""

from contextlib import AbstractContextManager, nullcontext

import torch
from torch import Tensor, nn

from daedalus.policy.component_inputs import normalized_components
from daedalus.policy.network.action_distribution import ActionDistribution
from daedalus.policy.network.encoders import build_codes, build_encoder
from daedalus.policy.network.exploration import Exploration
from daedalus.policy.network.layers import Components, orthogonal
from daedalus.policy.network.observation_normalizer import ObservationNormalizer
from daedalus.policy.network.recurrent_memory import Gru, NoMemory
from daedalus.policy.user_modules import NO_MODULES, UserModules
from daedalus.protocol.spaces import Spaces
from daedalus.protocol.spec import LossSpec, PolicySpec

_POLICY_GAIN = 0.01  # the initial policy is nearly uniform for every observation


class ActorCritic(nn.Module):
    """Codes and normaliser, encoder, memory, policy head with the distribution of actions, value head.

    Learning calls `forward`; acting needs only `act`, which is what the exported program computes. For an algorithm of
    action values, the outputs of the policy head are Q(s, a), and there is no value head.
    """

    def __init__(
        self, spec: PolicySpec, spaces: Spaces, modules: UserModules = NO_MODULES, training: LossSpec | None = None
    ) -> None:
        """Construct the network.

        Args:
          spec: settings of the network.
          spaces: of the environment.
          modules: modules that may be imported for it.
          training: names the algorithm, and whether actors explore; None: heads for policy and value, no exploration.

        Raises NetworkError if the encoder, the distribution or the algorithm does not fit the spaces, or a module may
        not be imported.
        """
        super().__init__()
        self.distribution = ActionDistribution(spec, spaces, modules, training)
        self.exploration = Exploration(spaces) if training is not None and training.explores else None
        self.normalizer = ObservationNormalizer(normalized_components(spec, spaces.observations))
        self.codes = build_codes(spec, spaces.observations)
        self.encoder = build_encoder(spec, spaces.observations, modules)
        features = self.encoder.features
        self.memory = Gru(features, spec.memory_units) if spec.memory == "gru" else NoMemory(features)
        self.policy_head = orthogonal(nn.Linear(self.memory.features, self.distribution.parameter_count), _POLICY_GAIN)
        has_values = training is None or training.record.heads == "policy_and_value"
        self.value_head = orthogonal(nn.Linear(self.memory.features, 1)) if has_values else None
        # Whether the network has convolutions, which then take most of its time.
        self.convolutional = any(isinstance(module, nn.Conv2d) for module in self.modules())
        self.has_user_modules = bool(spec.user_modules)
        separate = spec.separate_value_encoder and spec.memory == "none" and has_values
        self.value_encoder = build_encoder(spec, spaces.observations, modules) if separate else None

    @property
    def state_size(self) -> int:
        """S, the size of the memory's state; 0 without a memory."""
        return self.memory.state_size

    @property
    def uniform_count(self) -> int:
        """U, uniform random numbers that the choice of one action takes."""
        return self.distribution.uniform_count + (self.exploration.uniform_count if self.exploration else 0)

    def learned_parameters(self) -> list[nn.Parameter]:
        """Return the parameters that have gradients: all but the statistics of the normaliser."""
        return [parameter for parameter in self.parameters() if parameter.requires_grad]

    def forward(self, observations: Components, state: Tensor, starts: Tensor) -> tuple[Tensor, Tensor]:
        """Compute policies and values for R consecutive rows of B environments.

        Args:
          observations: of each component [R, B, *stacked_shape].
          state, starts: as in `unroll`.

        Returns: as `unroll`.
        """
        return self.unroll(self.prepare(observations), state, starts)

    def prepare(self, observations: Components) -> Components:
        """Make codes one-hot and normalise numbers: {name: [..., *stacked_shape]}, for any leading axes."""
        return self.normalizer(self.codes(observations))

    def unroll(self, prepared: Components, state: Tensor, starts: Tensor) -> tuple[Tensor, Tensor]:
        """Compute policies and values for R consecutive rows of B environments from prepared observations.

        Args:
          prepared: what `prepare` returns, of each component [R, B, ...].
          state: [B, S] float32, the memory before row 0.
          starts: [R, B] bool, whether an episode starts with the row, which clears the memory.

        Returns: parameters of the action distributions [R, B, P] and values [R, B], float32 also under autocast. The
        values are 0 without a value head.
        """
        flat = _flattened(prepared)
        remembered, _ = self._remembered(flat, state, starts)
        critic = remembered
        if self.value_encoder is not None:
            critic = self.value_encoder(flat).unflatten(0, starts.shape)
        with full_precision(remembered):
            parameters = self.policy_head(remembered.float())
            if self.value_head is None:
                return parameters, parameters.new_zeros(parameters.shape[:-1])
            return parameters, self.value_head(critic.float()).squeeze(-1)

    def policy(self, prepared: Components, state: Tensor, starts: Tensor) -> tuple[Tensor, Tensor]:
        """Compute the policies alone: as `unroll`, but with the state after the last row [B, S] in place of values."""
        remembered, state = self._remembered(_flattened(prepared), state, starts)
        with full_precision(remembered):
            return self.policy_head(remembered.float()), state

    def _remembered(self, flat: Components, state: Tensor, starts: Tensor) -> tuple[Tensor, Tensor]:
        """Return the inputs of the policy head [R, B, F'] and the state after the last row, from [R x B, ...]."""
        return self.memory.unroll(self.encoder(flat).unflatten(0, starts.shape), state, starts)

    def step(self, observations: Components, state: Tensor) -> tuple[Tensor, Tensor]:
        """Compute the policies of one row: state [N, S] -> distribution parameters [N, P], next state [N, S]."""
        remembered, state = self.memory.step(self.encoder(self.prepare(observations)), state)
        return self.policy_head(remembered), state

    def act(
        self,
        observations: Components,
        state: Tensor,
        uniform: Tensor,
        normal: Tensor,
        masks: Components,
        epsilon: Tensor,
    ) -> tuple[Components, Tensor, Tensor]:
        """Choose the actions of one row of N environments.

        Args:
          observations: of each component [N, *stacked_shape].
          state: [N, S].
          uniform: [N, U] noise from 0 to 1, 1 excluded.
          normal: [N, G] standard normal noise.
          masks: of the masked actions [N, choices] bool.
          epsilon: [N, 1], the final epsilon of the actor of each row; 0 never explores.

        Returns: actions of each component [N, D], their log-probability [N] under the behaviour policy, next state
        [N, S].
        """
        parameters, state = self.step(observations, state)
        if self.exploration is not None:
            explored = self.exploration.act(self.distribution, parameters, uniform, normal, masks, epsilon)
            return *explored, state
        actions = self.distribution.sample(parameters, uniform, normal, masks)
        return actions, self.distribution.log_prob(parameters, actions, masks), state


def _flattened(prepared: Components) -> Components:
    return {name: values.flatten(0, 1) for name, values in prepared.items()}


def full_precision(features: Tensor) -> AbstractContextManager[object]:
    """Return the context of the heads: bfloat16 would round values and logits to 8 bits, much of a TD error."""
    device = features.device.type
    return torch.autocast(device, enabled=False) if torch.is_autocast_enabled(device) else nullcontext()
