"""The encoders by name. Needs torch: actors do not import this file.

Each is an nn.Module [N, *stacked_shape] -> [N, features] with the attribute `features`.
"""

import math

import torch
from torch import Tensor, nn

from daedalus.policy.network.convolutional import ArticleEncoder, ImageEncoder, impala, nature, small
from daedalus.policy.network.custom_encoder import CustomEncoder
from daedalus.policy.network.layers import orthogonal
from daedalus.policy.user_modules import NO_MODULES, UserModules
from daedalus.protocol.spaces import ArraySpace
from daedalus.protocol.spec import PolicySpec

_ACTIVATIONS: dict[str, type[nn.Module]] = {"tanh": nn.Tanh, "relu": nn.ReLU}
_GAIN = math.sqrt(2.0)
_SMALLEST_IMAGE = 16  # pixels of its shorter side; smaller arrays of bytes are no pictures
_SMALLEST_FOR_NATURE = 36


class MultilayerPerceptron(nn.Module):
    """Fully connected layers (possibly none) on the flattened observation: [N, *stacked_shape] -> [N, features].

    `uint8` observations are scaled to [0, 1].
    """

    def __init__(self, space: ArraySpace, hidden: tuple[int, ...], activation: str) -> None:
        super().__init__()
        self._scale = 1.0 / 255.0 if space.dtype == "uint8" else None
        layers: list[nn.Module] = []
        width = math.prod(space.stacked_shape)
        for units in hidden:
            layers += [orthogonal(nn.Linear(width, units), _GAIN), _ACTIVATIONS[activation]()]
            width = units
        self.layers = nn.Sequential(*layers)
        self.features = width

    def forward(self, observations: Tensor) -> Tensor:
        """Encode observations: [N, *stacked_shape] -> [N, features]."""
        flat = observations.flatten(1)  # [N, prod(stacked_shape)]
        if self._scale is not None:
            flat = flat.to(torch.float32) * self._scale
        return self.layers(flat)


Encoder = MultilayerPerceptron | ImageEncoder | CustomEncoder


def build_encoder(spec: PolicySpec, space: ArraySpace, modules: UserModules = NO_MODULES) -> Encoder:
    """Return the encoder that the specification names, for observations of the space.

    Raises NetworkError if a custom encoder may not or cannot be imported, or the encoder does not accept the
    observations.
    """
    name = encoder_name(spec, space)
    match name:
        case "mlp":
            return MultilayerPerceptron(space, spec.hidden, spec.activation)
        case "nature":
            return nature(space)
        case "small":
            return small(space)
        case "impala":
            return impala(space)
        case "article":
            return ArticleEncoder(space)
        case _:
            return CustomEncoder(name, space, modules)


def encoder_name(spec: PolicySpec, space: ArraySpace) -> str:
    """Return the name of the encoder for a space; `auto` chooses convolutions for images of bytes."""
    if spec.encoder != "auto":
        return spec.encoder
    sides = sorted(space.shape)[-2:]  # colours first or last: the longest sides are those of the image
    if space.dtype != "uint8" or len(space.shape) not in (2, 3) or min(sides) < _SMALLEST_IMAGE:
        return "mlp"
    return "nature" if min(sides) >= _SMALLEST_FOR_NATURE else "impala"
