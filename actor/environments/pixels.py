"""Transforms of frames before they are stored and sent: crop, grey, resize. Pure functions, all E frames at once."""

from collections.abc import Callable
from functools import lru_cache, partial

import gymnasium
import numpy as np

from daedalus.actor.environments.environment_errors import EnvironmentSetupError, described
from daedalus.protocol.spaces import colours_last
from daedalus.protocol.spec import EnvironmentSpec

_GREY_WEIGHTS = (77, 150, 29)  # of red, green, blue in 256ths: ITU-R BT.601's 0.299, 0.587, 0.114


class Pixels:
    """The pixel transforms of a specification, in order; the identity if it has none."""

    def __init__(self, spec: EnvironmentSpec, space: gymnasium.spaces.Box) -> None:
        """Raises EnvironmentSetupError if a transform does not fit the space."""
        asked: list[tuple[str, Callable[[np.ndarray], np.ndarray]]] = []
        if spec.crop is not None:
            asked.append((f"crop={spec.crop}", partial(crop, margins=spec.crop)))
        if spec.grey:
            asked.append(("grey", grey))
        if spec.resize is not None:
            asked.append((f"resize={spec.resize}", partial(resize, size=spec.resize)))
        self._transforms = [transform for _, transform in asked]
        self._colours_first = len(space.shape) == 3 and not colours_last(space.shape)
        frames = np.zeros((1, *space.shape), space.dtype)
        for name, transform in asked:
            try:
                if frames.dtype != np.uint8 or frames.ndim not in (3, 4):
                    raise ValueError("frames must be uint8 images of shape (H, W), (H, W, C) or (C, H, W)")
                frames = self._apply(transform, frames)
            except ValueError as error:
                raise EnvironmentSetupError(
                    f"environment.{name} does not fit observation space {described(space)}: {error}"
                ) from None
        self.shape: tuple[int, ...] = frames.shape[1:]  # of one transformed frame

    def __call__(self, frames: np.ndarray) -> np.ndarray:
        """Return frames [E, *space.shape] transformed to [E, *shape]."""
        for transform in self._transforms:
            frames = self._apply(transform, frames)
        return frames

    def _apply(self, transform: Callable[[np.ndarray], np.ndarray], frames: np.ndarray) -> np.ndarray:
        """Apply a transform of frames whose colours are on the last axis."""
        if not self._colours_first or frames.ndim == 3:
            return transform(frames)
        transformed = transform(np.moveaxis(frames, 1, -1))
        return np.moveaxis(transformed, -1, 1) if transformed.ndim == 4 else transformed


def crop(frames: np.ndarray, margins: tuple[int, int, int, int]) -> np.ndarray:
    """Return a view of frames [E, H, W, ...] without `margins` pixels at the top, bottom, left and right."""
    top, bottom, left, right = margins
    height, width = frames.shape[1:3]
    if top + bottom >= height or left + right >= width:
        raise ValueError(f"the margins leave nothing of {height} x {width} pixels")
    return frames[:, top : height - bottom, left : width - right]


def grey(frames: np.ndarray) -> np.ndarray:
    """Return the luma by ITU-R BT.601 of RGB frames [E, H, W, 3], rounded to integers [E, H, W]."""
    if frames.ndim != 4 or frames.shape[3] != 3:
        raise ValueError(f"a frame of shape {frames.shape[1:]} is not RGB: it must have 3 colours")
    luma, part = (
        np.full(frames.shape[:3], 128, np.uint16),
        np.empty(frames.shape[:3], np.uint16),
    )  # 128: rounds to the nearest
    for channel, weight in enumerate(_GREY_WEIGHTS):
        np.multiply(frames[..., channel], weight, out=part, dtype=np.uint16)
        luma += part  # at most 255 * 256 + 128, which fits
    luma >>= 8
    return luma.astype(np.uint8)


def resize(frames: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """Return frames [E, H, W, ...] resized to `size` (h, w): each pixel is the mean of the area that it covers.

    Lengths are in units of 1/h and 1/w of a source pixel, in which all overlaps are integers: the sums are exact in
    float32 up to 65,793 source pixels, and rounded in the last bit beyond.
    """
    height, width = frames.shape[1:3]
    sums = _area_sums(_area_sums(frames, 1, size[0]), 2, size[1])
    sums /= height * width
    return np.rint(sums, out=sums).astype(np.uint8)


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
