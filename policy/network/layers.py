"""Layers that torch lacks, or has slower."""

from typing import Any, TypeVar

import torch
from torch import Tensor, nn
from torch.nn import functional

Layer = TypeVar("Layer", nn.Linear, nn.Conv2d)


def orthogonal(layer: Layer, gain: float = 1.0) -> Layer:
    """The layer, its weights orthogonal (Saxe et al. 2014) and its biases zero."""
    nn.init.orthogonal_(layer.weight, gain)
    if layer.bias is not None:
        nn.init.zeros_(layer.bias)
    return layer


class BytesConv2d(nn.Conv2d):
    """A convolution of bytes as numbers from 0 to 1: scales its weights, which are fewer, and in full precision."""

    def forward(self, input: Tensor) -> Tensor:
        """[N, C, H, W] in 0 to 255 -> [N, out_channels, ...]."""
        return self._conv_forward(input, self.weight * (1.0 / 255.0), self.bias)


class PReLU(nn.Module):
    """x where it is positive, elsewhere x times one learned slope (He et al. 2015)."""

    def __init__(self) -> None:
        super().__init__()
        self.slope = nn.Parameter(torch.full((1,), 0.25))

    def forward(self, inputs: Tensor) -> Tensor:
        """[N, C, H, W] -> the same."""
        if inputs.is_cuda:
            return functional.prelu(inputs, self.slope.to(inputs.dtype))
        return _Rectify.apply(inputs, self.slope)  # pyright: ignore[reportReturnType]


class _Rectify(torch.autograd.Function):
    """PReLU's two passes; on a CPU torch's own backward takes seven times as long."""

    @staticmethod
    def forward(ctx: Any, inputs: Tensor, slope: Tensor) -> Tensor:
        ctx.save_for_backward(inputs, slope)
        return functional.leaky_relu(inputs, slope.item())

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor, Tensor]:
        (outer,) = gradients
        inputs, slope = ctx.saved_tensors
        inner = torch.ops.aten.leaky_relu_backward(outer, inputs, slope.item(), False)
        by_image = torch.linalg.vecdot(_pixels(outer), _pixels(inputs.clamp(max=0.0)))  # [N]
        return inner, by_image.sum(dtype=slope.dtype).view_as(slope)

    @staticmethod
    def symbolic(graph: Any, inputs: Any, slope: Any) -> Any:
        """The same for the ONNX exporter: onnxruntime takes twice as long for an article network with its PRelu."""
        positive = graph.op("Relu", inputs)
        negative = graph.op("Sub", inputs, positive)
        return graph.op("Add", positive, graph.op("Mul", negative, slope)).setType(inputs.type())


def _pixels(images: Tensor) -> Tensor:
    """[N, C, H, W] -> [N, H * W * C]; a view where the images lie pixel by pixel (channels_last)."""
    return images.movedim(1, -1).flatten(1)
