"""The actor-critic network, built from its specification. Needs torch: actors do not import this file."""

import torch
from torch import Tensor, nn

from daedalus.policy.network.distributions import distribution_for
from daedalus.policy.network.encoders import build_encoder
from daedalus.policy.network.layers import orthogonal
from daedalus.policy.network.memory import Gru, NoMemory
from daedalus.policy.user_modules import NO_MODULES, UserModules
from daedalus.protocol.spaces import Spaces
from daedalus.protocol.spec import PolicySpec

_POLICY_GAIN = 0.01  # the initial policy is nearly uniform for every observation


class ActorCritic(nn.Module):
    """Encoder, memory, policy head, value head.

    Learning calls `forward`; acting needs only `act`, which is what the exported program computes.
    """

    def __init__(self, spec: PolicySpec, spaces: Spaces, modules: UserModules = NO_MODULES) -> None:
        """Raise NetworkError if the encoder does not accept observations of this space, or may not be imported."""
        super().__init__()
        self.distribution = distribution_for(spaces.action)
        self.encoder = build_encoder(spec, spaces.observation, modules)
        features = self.encoder.features
        self.memory = Gru(features, spec.memory_units) if spec.memory == "gru" else NoMemory(features)
        self.policy_head = orthogonal(nn.Linear(self.memory.features, self.distribution.parameter_count), _POLICY_GAIN)
        self.value_head = orthogonal(nn.Linear(self.memory.features, 1))

    @property
    def state_size(self) -> int:
        """S, the size of the memory's state; 0 without a memory."""
        return self.memory.state_size

    @property
    def convolutional(self) -> bool:
        """Whether the network has convolutions, which then take most of its time."""
        return any(isinstance(module, nn.Conv2d) for module in self.modules())

    def forward(self, observations: Tensor, state: Tensor, starts: Tensor) -> tuple[Tensor, Tensor]:
        """Compute policies and values for R consecutive rows of B environments.

        Args:
          observations: [R, B, *stacked_shape].
          state: [B, S] float32, the memory before row 0.
          starts: [R, B] bool, whether an episode starts with the row, which clears the memory.

        Returns: parameters of the action distributions [R, B, P] (for a discrete space logits, P = A) and values
        [R, B], float32 also under autocast.
        """
        features = self.encoder(observations.flatten(0, 1)).unflatten(0, starts.shape)  # [R, B, F]
        remembered = self.memory.unroll(features, state, starts)
        # Both heads in full precision: bfloat16 would round values and logits to 8 bits, which is much of a TD error.
        with torch.autocast(remembered.device.type, enabled=False):
            remembered = remembered.float()
            return self.policy_head(remembered), self.value_head(remembered).squeeze(-1)

    def act(self, observations: Tensor, state: Tensor) -> tuple[Tensor, Tensor]:
        """Compute one row: observations [N, *stacked_shape], state [N, S] -> parameters [N, P], next state [N, S]."""
        remembered, state = self.memory.step(self.encoder(observations), state)
        return self.policy_head(remembered), state
