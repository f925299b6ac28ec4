"""The encoders by name. Needs torch: actors do not import this file.

Each is an nn.Module with the attribute `features`: that of one array maps [N, *stacked_shape] to [N, features], that of
several components takes a map of them.
"""

import math
from collections.abc import Callable
from itertools import chain

import torch
from torch import Tensor, nn

from daedalus.policy.component_inputs import coded_components, codes_problem, encoded_spaces, grid_components
from daedalus.policy.network.convolutional import ArticleEncoder, GridConvolution, ImageEncoder, impala, nature, small
from daedalus.policy.network.custom_encoder import CustomEncoder
from daedalus.policy.network.layers import Components, OneHotCodes, variables_and_values
from daedalus.policy.network.perceptron import Perceptron
from daedalus.policy.user_modules import NO_MODULES, NetworkError, UserModules
from daedalus.protocol.spaces import ArraySpace, DiscreteSpace, ObservationSpaces
from daedalus.protocol.spec import PolicySpec

ImageHead = Callable[[int], tuple[nn.Module, int]]  # from the outputs of convolutions; with its number of outputs

_SMALLEST_FOR_NATURE = 36  # pixels of the shorter side


class FlatEncoder(nn.Module):
    """Fully connected layers (possibly none) on all components side by side: {name: [N, ...]} -> [N, features].

    Arrays are flattened, `uint8` ones that are not normalised scaled to [0, 1]; discrete components are one-hot. With
    the encoder `grid`, maps go through a convolution before.
    """

    def __init__(self, spaces: ObservationSpaces, spec: PolicySpec) -> None:
        super().__init__()
        self._spaces = spaces
        grids = {name: GridConvolution(space) for name, space in grid_components(spec, spaces).items()}
        widths = [grids[name].width if name in grids else _width(space) for name, space in spaces.items()]
        self.layers = Perceptron(sum(widths), spec.hidden, spec.activation)
        self.grids = nn.ModuleList(grids.values())
        self._grids = dict(zip(grids, self.grids, strict=True))
        self.features = self.layers.features
        self._first_columns = _first_columns(spaces)
        # No buffers: they would become inputs of the exported program.
        self._choices = {
            name: variables_and_values(space.counts)
            for name, space in spaces.items()
            if isinstance(space, DiscreteSpace)
        }

    def forward(self, observations: Components) -> Tensor:
        """Encode observations."""
        if self._first_columns is not None:
            choices = torch.cat([observations[name] for name in self._spaces], -1)
            if self.layers.learns_fast(choices):
                return self.layers.of_choices(choices + self._first_columns)
        parts = [self._inputs(name, observations[name]) for name in self._spaces]
        return self.layers(parts[0] if len(parts) == 1 else torch.cat(parts, -1))

    def _inputs(self, name: str, observations: Tensor) -> Tensor:
        """Return the inputs of the layers [N, width] float32 for one component."""
        if name in self._grids:
            return self._grids[name](observations)
        space = self._spaces[name]
        if isinstance(space, ArraySpace):
            return _numbers(observations)
        variables, values = self._choices[name]
        if variables.device != observations.device:  # once
            self._choices[name] = variables, values = variables.to(observations.device), values.to(observations.device)
        # Of one variable nothing is selected, which would take longer than the comparison.
        chosen = observations if space.size == 1 else observations.index_select(-1, variables)
        # Comparisons, because torch's one_hot reads the values, which a recording (algorithms/recording.py) cannot.
        return (chosen == values).to(torch.float32)


class ArrayEncoder(nn.Module):
    """An encoder of one array, as the encoder of a map with this component. The parameters keep their names."""

    def __init__(self, name: str, encoder: ImageEncoder) -> None:
        super().__init__()
        self._name, self.features = name, encoder.features
        self._encoder = [encoder]  # in a list, so that it is not registered and its parameters keep their names
        for child_name, child in encoder.named_children():
            self.add_module(child_name, child)

    @property
    def image_encoders(self) -> dict[str, ImageEncoder]:
        """The encoder of each image, by component."""
        return {self._name: self._encoder[0]}

    def forward(self, observations: Components) -> Tensor:
        """Encode observations: {name: [N, *stacked_shape]} -> [N, features]."""
        return self._encoder[0](observations[self._name])


class CompositeEncoder(nn.Module):
    """An encoder for each image, and a multilayer perceptron for everything else; their features side by side."""

    def __init__(
        self, images: dict[str, ArraySpace], others: ObservationSpaces, spec: PolicySpec, head: ImageHead | None
    ) -> None:
        super().__init__()
        self._names = tuple(images)
        self._encoders = encoders = [_image_encoder(spec.encoder, space, head) for space in images.values()]
        self.images = nn.ModuleList(encoders)
        self.others = FlatEncoder(others, spec) if others else None
        self.features = sum(encoder.features for encoder in encoders)
        self.features += self.others.features if self.others is not None else 0

    @property
    def image_encoders(self) -> dict[str, ImageEncoder]:
        """The encoder of each image, by component."""
        return dict(zip(self._names, self._encoders, strict=True))

    def forward(self, observations: Components) -> Tensor:
        """Encode observations: {name: [N, *stacked_shape]} -> [N, features]."""
        parts = [encoder(observations[name]) for name, encoder in self.image_encoders.items()]
        if self.others is not None:
            parts.append(self.others(observations))
        return torch.cat(parts, -1)


Encoder = FlatEncoder | ArrayEncoder | CompositeEncoder | CustomEncoder


def image_encoders(encoder: Encoder) -> dict[str, ImageEncoder]:
    """Return the encoder of each image, by component: it takes the outputs of its convolutions in place of images."""
    return encoder.image_encoders if isinstance(encoder, ArrayEncoder | CompositeEncoder) else {}


def build_codes(spec: PolicySpec, spaces: ObservationSpaces) -> OneHotCodes:
    """Return what makes one-hot numbers of codes. Raises NetworkError if `policy.codes` do not fit the spaces."""
    if problem := codes_problem(spec, spaces):
        raise NetworkError(problem)
    return OneHotCodes(coded_components(spec, spaces))


def build_encoder(
    spec: PolicySpec,
    spaces: ObservationSpaces,
    modules: UserModules = NO_MODULES,
    head: ImageHead | None = None,
) -> Encoder:
    """Return the encoder that the specification names, for observations of the spaces.

    Of several components, images go through the named encoder, everything else through the multilayer perceptron.
    `head` takes the place of what follows the convolutions of an image; see ImageEncoder.

    Raises NetworkError if a custom encoder may not or cannot be imported, or the encoder does not accept the
    observations.
    """
    if ":" in spec.encoder:
        return CustomEncoder(spec, spaces, modules)
    coded = coded_components(spec, spaces)
    spaces = encoded_spaces(spec, spaces)
    images = {name: space for name, space in spaces.items() if isinstance(space, ArraySpace) and space.is_image}
    if spec.encoder == "grid" and not grid_components(spec, spaces):
        raise NetworkError(
            "the encoder 'grid' takes maps (height, width, planes), but the observations have no array of three axes: "
            "set policy.encoder to mlp, or add an axis in a wrapper"
        )
    if spec.encoder in ("mlp", "grid") or (spec.encoder == "auto" and not images):
        return FlatEncoder(spaces, spec)
    if len(spaces) == 1:
        if coded:
            raise NetworkError(
                f"the encoder {spec.encoder!r} takes no codes: set policy.encoder to mlp or grid, or policy.codes=none"
            )
        name, space = next(iter(spaces.items()))
        if isinstance(space, DiscreteSpace):
            raise NetworkError(f"the encoder {spec.encoder!r} takes arrays, not {space}: set policy.encoder to mlp")
        return ArrayEncoder(name, _image_encoder(spec.encoder, space, head))
    if not images:
        raise NetworkError(
            f"the encoder {spec.encoder!r} takes images of bytes with at least 16 x 16 pixels, but the observations "
            "have none: set policy.encoder to mlp"
        )
    return CompositeEncoder(images, {name: space for name, space in spaces.items() if name not in images}, spec, head)


def encoder_names(spec: PolicySpec, spaces: ObservationSpaces) -> str:
    """Return the names of the encoders that `build_encoder` makes, such as `nature and mlp`."""
    if ":" in spec.encoder or spec.encoder in ("mlp", "grid"):
        return spec.encoder
    images = [space for space in spaces.values() if isinstance(space, ArraySpace) and space.is_image]
    names = [_image_encoder_name(spec.encoder, space) for space in images]
    return " and ".join(dict.fromkeys([*names, *(["mlp"] if len(images) < len(spaces) else [])]))


def _image_encoder_name(name: str, space: ArraySpace) -> str:
    if name != "auto":
        return name
    return "nature" if min(space.image_shape[1:]) >= _SMALLEST_FOR_NATURE else "impala"


def _image_encoder(name: str, space: ArraySpace, head: ImageHead | None) -> ImageEncoder:
    build = {"nature": nature, "small": small, "impala": impala}.get(_image_encoder_name(name, space), ArticleEncoder)
    encoder = build(space)
    if head is not None:
        encoder.replace_head(head)
    return encoder


def _width(space: ArraySpace | DiscreteSpace) -> int:
    return space.choices if isinstance(space, DiscreteSpace) else math.prod(space.stacked_shape)


def _first_columns(spaces: ObservationSpaces) -> Tensor | None:
    """Return the first one-hot column of each variable [K] int64; None if a component is not discrete."""
    counts = [space.counts for space in spaces.values() if isinstance(space, DiscreteSpace)]
    if len(counts) < len(spaces):
        return None
    _, values = variables_and_values(tuple(chain.from_iterable(counts)))
    return torch.nonzero(values == 0).squeeze(-1)


def _numbers(observations: Tensor) -> Tensor:
    """Return the inputs of a perceptron [N, width] float32 for arrays."""
    flat = observations.flatten(1)
    return flat if flat.dtype == torch.float32 else flat.to(torch.float32) * (1.0 / 255.0)
