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
        return self._in_few_operations(input) if self.learns_fast(input) else super().forward(input)

    def of_choices(self, columns: Tensor) -> Tensor:
        """Compute the features of N rows, of which each has the input 1 in a few columns [N, K] int64, and else 0.

        Only where `learns_fast` says so. With 500 columns an update takes a third less time than with one-hot inputs.
        """
        return self._in_few_operations(columns)

    def learns_fast(self, input: Tensor) -> bool:
        """Whether gradients of this input, which needs none itself, are computed in few operations: on a CPU."""
        mixed = torch.is_autocast_enabled(input.device.type)
        return bool(len(self)) and torch.is_grad_enabled() and input.device.type == "cpu" and not mixed

    def _in_few_operations(self, input: Tensor) -> Tensor:
        parameters = [each for layer in self._linear for each in (layer.weight, layer.bias)]
        return _Layers.apply(input, self._is_tanh, *parameters)  # pyright: ignore[reportReturnType]


class _Layers(torch.autograd.Function):
    """All layers as one node of the graph of gradients.

    With few rows and units most of an update's time is the cost of an operation as such: one node instead of two for
    each layer saves a quarter of it. A tanh by way of the sigmoid function takes a third of the time of torch's.
    """

    @staticmethod
    def forward(ctx: Any, inputs: Tensor, is_tanh: bool, *parameters: Tensor) -> Tensor:
        """Compute the features of inputs [N, inputs] float32, or [N, K] int64 as for Perceptron.of_choices."""
        outputs = [inputs]
        factor = 2 if is_tanh else 1
        for weight, bias in zip(parameters[::2], parameters[1::2], strict=True):
            if outputs[-1].dtype == torch.int64:
                output = torch.embedding(weight.t(), inputs).sum(1).add_(bias).mul_(factor)
            else:
                output = torch.addmm(bias, outputs[-1], weight.t(), beta=factor, alpha=factor)
            outputs.append(_tanh_of_half(output) if is_tanh else output.relu_())
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
            results += [inner.sum(0), _weight_gradient(inner, outputs[layer], weights[layer].shape[1])]
            outer = inner @ weights[layer] if layer or ctx.needs_input_grad[0] else None
        return outer, None, *reversed(results)


def _weight_gradient(inner: Tensor, inputs: Tensor, width: int) -> Tensor:
    """Return the gradient of the weights of a layer [units, width], from that of its outputs [N, units]."""
    if inputs.dtype != torch.int64:
        # Few columns on the right take several times longer than few rows on the left.
        return inner.t() @ inputs if 4 * width > inner.shape[1] else (inputs.t() @ inner).t()
    columns = inputs.shape[1]
    each = inner if columns == 1 else inner.repeat_interleave(columns, 0)
    return torch.ops.aten.embedding_dense_backward(each, inputs.flatten(), width, -1, False).t()


def _tanh_of_half(values: Tensor) -> Tensor:
    """Replace values 2x by tanh(x), which is 2 sigmoid(2x) - 1."""
    half = values.sigmoid_()
    return half.add_(half).sub_(1.0)  # a sum, because a multiplication by a number takes longer
