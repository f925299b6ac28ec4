"""The actor-critic network, built from its specification. Torch: the actor never imports this file."""

from torch import Tensor, nn

from daedalus.policy.network.encoders import build_encoder
from daedalus.policy.network.layers import orthogonal
from daedalus.policy.network.memory import Gru, NoMemory
from daedalus.protocol.spaces import Spaces
from daedalus.protocol.spec import PolicySpec

_POLICY_GAIN = 0.01  # the first policy is nearly uniform, whatever the observation


class ActorCritic(nn.Module):
    """Encoder, memory, policy head, value head.

    `forward` is what learning uses; `act` is the part that acting needs, and what the program is made of.
    """

    def __init__(self, spec: PolicySpec, spaces: Spaces) -> None:
        """Raises NetworkError if the encoder is not for such observations."""
        super().__init__()
        self.encoder = build_encoder(spec, spaces.observation)
        features = self.encoder.features
        self.memory = Gru(features, spec.memory_units) if spec.memory == "gru" else NoMemory(features)
        self.policy_head = orthogonal(nn.Linear(self.memory.features, spaces.action.count), _POLICY_GAIN)
        self.value_head = orthogonal(nn.Linear(self.memory.features, 1))

    @property
    def state_size(self) -> int:
        """S, the numbers that the memory keeps from row to row; 0 without one."""
        return self.memory.state_size

    @property
    def convolutional(self) -> bool:
        """Whether convolutions are what it spends its time on."""
        return any(isinstance(module, nn.Conv2d) for module in self.modules())

    def forward(self, observations: Tensor, state: Tensor, starts: Tensor) -> tuple[Tensor, Tensor]:
        """R rows of B environments, in their order.

        Args:
          observations: [R, B, *stacked_shape].
          state: [B, S] float32, the memory before row 0.
          starts: [R, B] bool, whether an episode starts with the row, so that nothing before it is remembered.

        Returns: logits [R, B, A], values [R, B], float32 also under autocast.
        """
        features = self.encoder(observations.flatten(0, 1)).unflatten(0, starts.shape)  # [R, B, F]
        remembered = self.memory.unroll(features, state, starts)
        return self.policy_head(remembered).float(), self.value_head(remembered).squeeze(-1).float()

    def act(self, observations: Tensor, state: Tensor) -> tuple[Tensor, Tensor]:
        """One row: observations [N, *stacked_shape], state [N, S] -> logits [N, A], next state [N, S]."""
        remembered, state = self.memory.step(self.encoder(observations), state)
        return self.policy_head(remembered), state
