"""Transforms of frames before they are stored and sent: crop, grey, resize. Pure functions, all E frames at once."""

import math
from collections.abc import Callable
from functools import lru_cache, partial
from typing import TYPE_CHECKING, NamedTuple

import gymnasium
import numpy as np

from daedalus.actor.environments.environment_errors import EnvironmentSetupError, described
from daedalus.protocol.spaces import colours_last
from daedalus.protocol.spec import EnvironmentSpec

if TYPE_CHECKING:
    from daedalus.policy.saving.onnx_graph import OnnxGraph

Shape = tuple[int, ...]  # of one frame

_GREY_WEIGHTS = (77, 150, 29)  # of red, green, blue in 256ths: ITU-R BT.601's 0.299, 0.587, 0.114


class _Transform(NamedTuple):
    """One transform of frames whose colours are on the last axis. Its functions of shapes are for one frame."""

    name: str  # as the specification states it
    apply: Callable[[np.ndarray], np.ndarray]
    shape: Callable[[Shape], Shape]  # of the transformed frame; raises ValueError if the transform does not fit
    work_bytes: Callable[[Shape], int]  # size of the largest array that `apply` allocates for one frame
    exported: Callable[["OnnxGraph", str, Shape], str]  # adds what `apply` does, to the bit, to an ONNX graph


class Pixels:
    """The pixel transforms of a specification, in order; the identity if it has none.

    `shape` is that of one transformed frame. `largest_bytes` is the size of the largest array in the transforms of one
    frame, the frame included. Both are computed without an array: a space may be very large.
    """

    def __init__(self, spec: EnvironmentSpec, space: gymnasium.spaces.Box) -> None:
        """Raises EnvironmentSetupError if a transform does not fit the space."""
        self._transforms = _transforms(spec)
        self._colours_first = len(space.shape) == 3 and not colours_last(space.shape)
        shape = self._first_shape = (*space.shape[1:], space.shape[0]) if self._colours_first else space.shape
        self.largest_bytes = math.prod(shape) * np.dtype(space.dtype).itemsize
        for transform in self._transforms:
            try:
                if space.dtype != np.uint8 or len(shape) not in (2, 3):
                    raise ValueError("frames must be uint8 images of shape (H, W), (H, W, C) or (C, H, W)")
                transformed = transform.shape(shape)
            except ValueError as error:
                raise EnvironmentSetupError(
                    f"environment.{transform.name} does not fit observation space {described(space)}: {error}"
                ) from None
            self.largest_bytes = max(self.largest_bytes, transform.work_bytes(shape))
            shape = transformed
        self.shape = (shape[-1], *shape[:-1]) if self._colours_first and len(shape) == 3 else shape

    def __call__(self, frames: np.ndarray) -> np.ndarray:
        """Return frames [E, *space.shape] transformed to [E, *shape]."""
        for transform in self._transforms:
            frames = self._apply(transform.apply, frames)
        return frames

    def exported(self, graph: "OnnxGraph", frames: str) -> str:
        """Add the transforms to an ONNX graph: [rows, *space.shape] -> [rows, *self.shape]."""
        shape = self._first_shape
        if self._colours_first:
            frames = graph.add("Transpose", frames, perm=[0, 2, 3, 1])
        for transform in self._transforms:
            frames, shape = transform.exported(graph, frames, shape), transform.shape(shape)
        return graph.add("Transpose", frames, perm=[0, 3, 1, 2]) if self._colours_first and len(shape) == 3 else frames

    def _apply(self, transform: Callable[[np.ndarray], np.ndarray], frames: np.ndarray) -> np.ndarray:
        """Apply a transform of frames whose colours are on the last axis."""
        if not self._colours_first or frames.ndim == 3:
            return transform(frames)
        transformed = transform(np.moveaxis(frames, 1, -1))
        return np.moveaxis(transformed, -1, 1) if transformed.ndim == 4 else transformed


def _transforms(spec: EnvironmentSpec) -> list[_Transform]:
    """Return the transforms of a specification in order."""
    transforms = []
    if (margins := spec.crop) is not None:
        shape = partial(_cropped_shape, margins=margins)
        exported = partial(_exported_crop, margins=margins)
        transforms.append(_Transform(f"crop={margins}", partial(crop, margins=margins), shape, _no_bytes, exported))
    if spec.grey:  # its largest array has two bytes for each pixel, where the frame has three
        transforms.append(_Transform("grey", grey, _grey_shape, _no_bytes, _exported_grey))
    if (size := spec.resize) is not None:
        shape, work_bytes = partial(_resized_shape, size=size), partial(_resize_bytes, size=size)
        exported = partial(_exported_resize, size=size)
        transforms.append(_Transform(f"resize={size}", partial(resize, size=size), shape, work_bytes, exported))
    return transforms


def _no_bytes(shape: Shape) -> int:
    return 0


def crop(frames: np.ndarray, margins: tuple[int, int, int, int]) -> np.ndarray:
    """Return a view of frames [E, H, W, ...] without `margins` pixels at the top, bottom, left and right."""
    top, _, left, _ = margins
    height, width = _cropped_shape(frames.shape[1:], margins)[:2]
    return frames[:, top : top + height, left : left + width]


def _exported_crop(graph: "OnnxGraph", frames: str, shape: Shape, margins: tuple[int, int, int, int]) -> str:
    top, _, left, _ = margins
    height, width = _cropped_shape(shape, margins)[:2]
    return graph.sliced(graph.sliced(frames, 1, top, top + height), 2, left, left + width)


def _cropped_shape(shape: Shape, margins: tuple[int, int, int, int]) -> Shape:
    top, bottom, left, right = margins
    height, width = shape[:2]
    if top + bottom >= height or left + right >= width:
        raise ValueError(f"the margins leave nothing of {height} x {width} pixels")
    return (height - top - bottom, width - left - right, *shape[2:])


def grey(frames: np.ndarray) -> np.ndarray:
    """Return the luma by ITU-R BT.601 of RGB frames [E, H, W, 3], rounded to integers [E, H, W]."""
    shape = (frames.shape[0], *_grey_shape(frames.shape[1:]))
    luma, part = np.full(shape, 128, np.uint16), np.empty(shape, np.uint16)  # 128: rounds to the nearest
    for channel, weight in enumerate(_GREY_WEIGHTS):
        np.multiply(frames[..., channel], weight, out=part, dtype=np.uint16)
        luma += part  # at most 255 * 256 + 128, which fits
    luma >>= 8
    return luma.astype(np.uint8)


def _exported_grey(graph: "OnnxGraph", frames: str, shape: Shape) -> str:
    """Add `grey`: the sums are whole numbers below 2 ** 24, which float32 has."""
    weights = graph.constant(np.reshape(_GREY_WEIGHTS, (3, 1)))
    luma = graph.reshaped(graph.add("MatMul", graph.cast(frames, np.float32), weights), _grey_shape(shape))
    luma = graph.add("Mul", graph.add("Add", luma, graph.constant(128.0)), graph.constant(1 / 256))
    return graph.cast(graph.add("Floor", luma), np.uint8)


def _grey_shape(shape: Shape) -> Shape:
    if len(shape) != 3 or shape[2] != 3:
        raise ValueError(f"a frame of shape {shape} is not RGB: it must have 3 colours")
    return shape[:2]


def resize(frames: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """Return frames [E, H, W, ...] resized to `size` (h, w): each pixel is the mean of the area that it covers.

    Lengths are in units of 1/h and 1/w of a source pixel, in which all overlaps are integers: the sums are exact in
    float32 up to 65,793 source pixels, and rounded in the last bit beyond.
    """
    height, width = frames.shape[1:3]
    sums = _area_sums(_area_sums(frames, 1, size[0]), 2, size[1])
    sums /= height * width
    return np.rint(sums, out=sums).astype(np.uint8)


def _exported_resize(graph: "OnnxGraph", frames: str, shape: Shape, size: tuple[int, int]) -> str:
    """Add `resize`: two products with the matrices of the overlaps."""
    height, width = shape[:2]
    frames = graph.cast(frames, np.float32)
    if len(shape) == 3:
        frames = graph.add("Transpose", frames, perm=[0, 3, 1, 2])
    sums = graph.add("MatMul", graph.constant(_overlap_matrix(height, size[0])), frames)
    sums = graph.add("MatMul", sums, graph.constant(_overlap_matrix(width, size[1]).T))
    if len(shape) == 3:
        sums = graph.add("Transpose", sums, perm=[0, 2, 3, 1])
    # Of a division after a product, onnxruntime makes factors of the product, which rounds in another way.
    means = graph.add("Div", graph.add("Abs", sums), graph.constant(height * width))
    return graph.cast(graph.add("Round", means), np.uint8)


def _overlap_matrix(source: int, target: int) -> np.ndarray:
    """Return how much of each source pixel each target pixel covers, [target, source]."""
    matrix = np.zeros((target, source), np.float32)
    for sources, weights in zip(*_overlaps(source, target), strict=True):
        np.add.at(matrix, (np.arange(target), sources), weights)
    return matrix


def _resized_shape(shape: Shape, size: tuple[int, int]) -> Shape:
    return (*size, *shape[2:])


def _resize_bytes(shape: Shape, size: tuple[int, int]) -> int:
    """Return the size of the sums over rows, float32, which have the new height and the old width."""
    return 4 * size[0] * math.prod(shape[1:])


def _area_sums(frames: np.ndarray, axis: int, target: int) -> np.ndarray:
    """Return the weighted sums of the source pixels that each target pixel covers on one axis.

    A matrix product would do the same, but BLAS would start threads for it.
    """
    sums = np.zeros((*frames.shape[:axis], target, *frames.shape[axis + 1 :]), np.float32)
    part = np.empty_like(sums)
    for sources, weights in zip(*_overlaps(frames.shape[axis], target), strict=True):
        np.multiply(frames.take(sources, axis), weights.reshape(-1, *[1] * (frames.ndim - 1 - axis)), out=part)
        sums += part
    return sums


@lru_cache(maxsize=16)
def _overlaps(source: int, target: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the source pixels that each target pixel covers, [K, target], and how much of each, float32 [K, target].

    Target pixel i spans [i * source, (i + 1) * source), source pixel j spans [j * target, (j + 1) * target).
    """
    starts = np.arange(target) * source
    sources = starts // target + np.arange((source - 1) // target + 2)[:, None]
    ends = np.minimum(starts + source, (sources + 1) * target)
    weights = np.maximum(ends - np.maximum(starts, sources * target), 0)
    return np.minimum(sources, source - 1), weights.astype(np.float32)
