"""All parameters of a network as one vector, and their gradients as another."""

import math
from collections.abc import Iterable

import torch
from torch import Tensor, nn


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

    def differentiated(self, loss: Tensor) -> Tensor:
        """Return the gradients of a loss [P]; 0 for a parameter that it does not depend on."""
        gradients = torch.autograd.grad(loss, self._parameters, materialize_grads=True)
        return torch.cat([gradient.flatten() for gradient in gradients])

    def clip_gradients(self, max_norm: float) -> float:
        """Scale the gradients so that their norm is at most `max_norm`; return their norm before scaling.

        Gradients whose norm is not finite are left as they are.
        """
        norm = float(torch.linalg.vector_norm(self.gradients))
        if max_norm < norm < math.inf:
            self.gradients.mul_(max_norm / (norm + 1e-6))
        return norm
