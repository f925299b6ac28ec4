"""All parameters of a network as one vector, and their gradients as another."""

from collections.abc import Iterable

import torch
from torch import Tensor, nn


class FlatParameters:
    """All parameters of a module as views into one vector, and their gradients as views into another.

    One vector replaces many small tensors: an optimiser step takes a few operations for any network, and the norm of
    the gradient takes one.
    """

    def __init__(self, parameters: Iterable[nn.Parameter]) -> None:
        parameters = list(parameters)
        self.values = torch.cat([parameter.detach().flatten() for parameter in parameters])  # [P]
        self.gradients = torch.zeros_like(self.values)  # [P]
        start = 0
        for parameter in parameters:
            end = start + parameter.numel()
            parameter.data = self.values[start:end].view_as(parameter)
            parameter.grad = self.gradients[start:end].view_as(parameter)
            start = end

    def clip_gradients(self, max_norm: float) -> Tensor:
        """Scale the gradients so that their norm is at most `max_norm`; return their norm before scaling."""
        norm = self.gradients.norm()
        self.gradients.mul_((max_norm / (norm + 1e-6)).clamp(max=1.0))
        return norm
