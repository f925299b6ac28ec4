"""The actor-critic network, built from its specification. Torch: the actor never imports this file."""

import math

import torch
from torch import Tensor, nn

from protocol.spec import ArraySpace, PolicySpec, Spaces

_ACTIVATIONS: dict[str, type[nn.Module]] = {"tanh": nn.Tanh, "relu": nn.ReLU}
_GAIN = math.sqrt(2.0)
_POLICY_GAIN = 0.01  # the first policy is nearly uniform, whatever the observation


class MultilayerPerceptron(nn.Module):
    """Encoder: flattens an observation and passes it through fully connected layers.

    [N, *observation_shape] -> [N, features]. `uint8` observations are scaled to [0, 1].
    """

    def __init__(self, observation: ArraySpace, hidden: tuple[int, ...], activation: str) -> None:
        super().__init__()
        self._scale = 1.0 / 255.0 if observation.dtype == "uint8" else None
        layers: list[nn.Module] = []
        width = math.prod(observation.shape)
        for units in hidden:
            layers += [_linear(width, units, _GAIN), _ACTIVATIONS[activation]()]
            width = units
        self.layers = nn.Sequential(*layers)
        self.features = width

    def forward(self, observations: Tensor) -> Tensor:
        """[N, *observation_shape] -> [N, features]."""
        flat = observations.flatten(1)  # [N, prod(observation_shape)]
        if self._scale is not None:
            flat = flat.to(torch.float32) * self._scale
        return self.layers(flat)


class ActorCritic(nn.Module):
    """Encoder, policy head, value head.

    `forward` is what learning uses; `act` is the part that acting needs, and what the program is made of.
    """

    def __init__(self, spec: PolicySpec, spaces: Spaces) -> None:
        super().__init__()
        self.encoder = MultilayerPerceptron(spaces.observation, spec.hidden, spec.activation)
        self.policy_head = _linear(self.encoder.features, spaces.action.count, _POLICY_GAIN)
        self.value_head = _linear(self.encoder.features, 1, 1.0)

    def forward(self, observations: Tensor) -> tuple[Tensor, Tensor]:
        """[N, *observation_shape] -> logits [N, actions], values [N]."""
        features = self.encoder(observations)
        return self.policy_head(features), self.value_head(features).squeeze(-1)

    def act(self, observations: Tensor) -> Tensor:
        """[N, *observation_shape] -> logits [N, actions]."""
        return self.policy_head(self.encoder(observations))


def _linear(inputs: int, outputs: int, gain: float) -> nn.Linear:
    layer = nn.Linear(inputs, outputs)
    nn.init.orthogonal_(layer.weight, gain)
    nn.init.zeros_(layer.bias)
    return layer
