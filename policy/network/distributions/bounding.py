"""Bounds of learned values that the values can leave again."""

from typing import Any

import torch
from torch import Tensor


def bounded(values: Tensor, low: float, high: float) -> Tensor:
    """Return the values clamped to [low, high]; beyond a bound, only gradients that lead back to it pass.

    torch's clamp has no gradient beyond its bounds: a value that has crossed one, such as by the momentum of the
    optimiser, would stay there for ever.
    """
    if not torch.is_grad_enabled():  # also in the export: the exporter knows clamp
        return values.clamp(low, high)
    return _Bounded.apply(values, low, high)  # pyright: ignore[reportReturnType]


class _Bounded(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, values: Tensor, low: float, high: float) -> Tensor:
        ctx.save_for_backward(values)
        ctx.low, ctx.high = low, high
        return values.clamp(low, high)

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor, None, None]:
        (outer,) = gradients
        (values,) = ctx.saved_tensors
        # Descent subtracts the gradient.
        leaves = ((values < ctx.low) & (outer > 0.0)) | ((values > ctx.high) & (outer < 0.0))
        return outer.masked_fill(leaves, 0.0), None, None
