"""Fully connected layers, with a backward pass of few operations for learning on a CPU."""

import math
from collections.abc import Sequence
from typing import Any, Literal

import torch
from torch import Tensor, nn

from daedalus.policy.network.layers import orthogonal

_GAIN = math.sqrt(2.0)


class Perceptron(nn.Sequential):
    """Linear layers (possibly none), each followed by the activation function: [N, inputs] -> [N, features]."""

    def __init__(self, inputs: int, hidden: Sequence[int], activation: Literal["tanh", "relu"]) -> None:
        layers: list[nn.Module] = []
        for units in hidden:
            layers += [orthogonal(nn.Linear(inputs, units), _GAIN), nn.Tanh() if activation == "tanh" else nn.ReLU()]
            inputs = units
        super().__init__(*layers)
        self.features = inputs
        self._is_tanh = activation == "tanh"
        self._linear = [layer for layer in layers if isinstance(layer, nn.Linear)]  # faster than to look for them

    def forward(self, input: Tensor) -> Tensor:
        """Compute the features of N rows."""
        mixed = torch.is_autocast_enabled(input.device.type)
        if len(self) and torch.is_grad_enabled() and input.device.type == "cpu" and not mixed:
            parameters = [each for layer in self._linear for each in (layer.weight, layer.bias)]
            return _Layers.apply(input, self._is_tanh, *parameters)  # pyright: ignore[reportReturnType]
        return super().forward(input)


class _Layers(torch.autograd.Function):
    """All layers as one node of the graph of gradients.

    With few rows and units most of an update's time is the cost of an operation as such: one node instead of two for
    each layer saves a quarter of it. A tanh by way of the sigmoid function takes a third of the time of torch's.
    """

    @staticmethod
    def forward(ctx: Any, inputs: Tensor, is_tanh: bool, *parameters: Tensor) -> Tensor:
        outputs = [inputs]
        for weight, bias in zip(parameters[::2], parameters[1::2], strict=True):
            output = torch.addmm(bias, outputs[-1], weight.t())
            outputs.append(_tanh(output) if is_tanh else output.relu_())
        ctx.is_tanh = is_tanh
        ctx.save_for_backward(*outputs, *parameters[::2])
        return outputs[-1]

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor | None, ...]:
        saved = ctx.saved_tensors
        count = len(saved) // 2
        outputs, weights = saved[: count + 1], saved[count + 1 :]
        (outer,) = gradients
        results: list[Tensor | None] = []
        for layer in reversed(range(count)):
            output = outputs[layer + 1]
            if ctx.is_tanh:
                inner = torch.ops.aten.tanh_backward(outer, output)
            else:
                inner = torch.ops.aten.threshold_backward(outer, output, 0)
            results += [inner.sum(0), inner.t() @ outputs[layer]]
            outer = inner @ weights[layer] if layer or ctx.needs_input_grad[0] else None
        return outer, None, *reversed(results)


def _tanh(values: Tensor) -> Tensor:
    """Replace values by their tanh, which is 2 sigmoid(2x) - 1."""
    half = values.add_(values).sigmoid_()  # sums, because a multiplication by a number takes longer
    return half.add_(half).sub_(1.0)
