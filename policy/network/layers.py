"""Layers that torch does not have, or that are slower in torch."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any, TypeVar

import torch
from torch import Tensor, nn
from torch.nn import functional

from daedalus.policy.user_modules import NetworkError, UserModules

Components = dict[str, Tensor]


def map_components(components: Components, function: Callable[[Tensor], Tensor]) -> Components:
    """Return the components with `function` applied to each."""
    return {name: function(values) for name, values in components.items()}


def variables_and_values(counts: Sequence[int]) -> tuple[Tensor, Tensor]:
    """Return the variable and the value of each choice, both [choices] int64.

    Of variables with 2 and 3 choices they are 0 0 1 1 1 and 0 1 0 1 2.
    """
    sizes = torch.tensor(counts)
    variables = torch.arange(len(counts)).repeat_interleave(sizes)
    return variables, torch.arange(len(variables)) - (sizes.cumsum(0) - sizes)[variables]


class OneHotCodes(nn.Module):
    """Codes as one-hot numbers: {name: [..., C] uint8} -> [..., codes of all C places] float32.

    Where a value is no code the numbers are NaN, and so are the log-probabilities of actions: the policy does not act
    on it unnoticed. The learner refuses such observations (protocol/spaces.py).
    """

    def __init__(self, codes: Mapping[str, tuple[int, ...]]) -> None:
        """Construct from the number of codes in each place of the last axis, by component."""
        super().__init__()
        # No buffers: they would become inputs of the exported program.
        self._tables: dict[str, tuple[Tensor, Tensor, Tensor]] = {}  # place and code of each number; codes of the place
        for name, counts in codes.items():
            places, values = variables_and_values(counts)
            self._tables[name] = places, values.float(), torch.tensor(counts)[places].float()

    def forward(self, observations: Components) -> Components:
        """Encode those of the given components that are codes; others are left as they are."""
        encoded = dict(observations)
        for name, tables in self._tables.items():
            if name not in observations:
                continue
            if tables[0].device != observations[name].device:  # once
                places, values, counts = (table.to(observations[name].device) for table in tables)
                self._tables[name] = tables = places, values, counts
            places, values, counts = tables
            # As floats, which every release of onnxruntime compares.
            given = observations[name].to(torch.float32).index_select(-1, places)
            encoded[name] = torch.where(given < counts, (given == values).to(torch.float32), torch.nan)
        return encoded


Layer = TypeVar("Layer", nn.Linear, nn.Conv2d)


def orthogonal(layer: Layer, gain: float = 1.0) -> Layer:
    """Return the layer with orthogonal weights (Saxe et al. 2014), scaled by `gain`, and zero biases."""
    nn.init.orthogonal_(layer.weight, gain)
    if layer.bias is not None:
        nn.init.zeros_(layer.bias)
    return layer


class BytesConv2d(nn.Conv2d):
    """Convolution of bytes scaled to [0, 1]. Scales the weights instead: they are fewer, and have full precision."""

    def forward(self, input: Tensor) -> Tensor:
        """Convolve images: [N, C, H, W] with values 0 to 255 -> [N, out_channels, ...]."""
        return self._conv_forward(input, self.weight * (1.0 / 255.0), self.bias)


class PReLU(nn.Module):
    """max(x, 0) + slope * min(x, 0) with one learned slope (He et al. 2015)."""

    def __init__(self) -> None:
        super().__init__()
        self.slope = nn.Parameter(torch.full((1,), 0.25))

    def forward(self, inputs: Tensor) -> Tensor:
        """Apply the function to each element: [N, C, H, W] -> the same shape."""
        if inputs.is_cuda:
            return functional.prelu(inputs, self.slope.to(inputs.dtype))
        return _Rectify.apply(inputs, self.slope)  # pyright: ignore[reportReturnType]


class _Rectify(torch.autograd.Function):
    """Forward and backward pass of PReLU; on a CPU torch's backward takes seven times as long."""

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
        """Export as Relu, Sub, Mul and Add: with PRelu, onnxruntime takes twice as long for the `article` network."""
        positive = graph.op("Relu", inputs)
        negative = graph.op("Sub", inputs, positive)
        return graph.op("Add", positive, graph.op("Mul", negative, slope)).setType(inputs.type())


def _pixels(images: Tensor) -> Tensor:
    """Flatten [N, C, H, W] to [N, H * W * C]; a view if the images are channels_last."""
    return images.movedim(1, -1).flatten(1)


Module = TypeVar("Module", bound=nn.Module)


def find_class(setting: str, reference: str, base: type[Module], modules: UserModules) -> type[Module]:
    """Return the class `module:Class` that a setting names.

    Raises UserModuleError if the module may not be imported or has no such name, and NetworkError if it names something
    else than a class derived from `base`.
    """
    found = modules.attribute(setting, reference)
    if not (isinstance(found, type) and issubclass(found, base)):
        kind = "torch.nn.Module" if base is nn.Module else base.__name__
        raise NetworkError(f"it is not a class of {kind}: name a class of your module")
    return found
