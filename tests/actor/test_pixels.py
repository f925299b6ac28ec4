"""Crop, grey and resize, compared with loops over the pixels."""

import itertools
import tracemalloc
from fractions import Fraction

import gymnasium
import numpy as np
import pytest

from daedalus.actor.environments.environment_errors import EnvironmentSetupError
from daedalus.actor.environments.pixels import Pixels, crop, grey, resize
from daedalus.protocol.spaces import ArraySpace
from daedalus.protocol.spec import EnvironmentSpec


def _noise(*shape: int) -> np.ndarray:
    return np.random.default_rng(1).integers(0, 256, shape, np.uint8)


def _space(*shape: int, dtype: type = np.uint8) -> gymnasium.spaces.Box:
    return gymnasium.spaces.Box(0, 255, shape, dtype)


def _covered(source: int, target: int, index: int) -> list[tuple[int, Fraction]]:
    """The source pixels that target pixel `index` covers, and what fraction of each."""
    start, end = Fraction(index * source, target), Fraction((index + 1) * source, target)
    overlaps = [(pixel, min(end, Fraction(pixel + 1)) - max(start, Fraction(pixel))) for pixel in range(source)]
    return [(pixel, overlap) for pixel, overlap in overlaps if overlap > 0]


def _resize_slowly(image: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    result = np.zeros((*size, *image.shape[2:]), np.uint8)
    for row, column in itertools.product(*map(range, size)):
        total = Fraction(0)
        for y, tall in _covered(image.shape[0], size[0], row):
            for x, wide in _covered(image.shape[1], size[1], column):
                total = total + image[y, x].astype(object) * (tall * wide)
        mean = total * Fraction(size[0] * size[1], image.shape[0] * image.shape[1])
        result[row, column] = np.vectorize(round, otypes=[int])(mean)
    return result


@pytest.mark.parametrize(
    ("shape", "size"),
    [((6, 8), (3, 4)), ((7, 9), (4, 5)), ((10, 6, 3), (4, 4)), ((5, 4), (5, 3)), ((3, 3, 1), (5, 7)), ((6, 6), (1, 1))],
)
def test_resize_computes_exact_means_of_areas(shape: tuple[int, ...], size: tuple[int, int]) -> None:
    images = _noise(3, *shape)
    expected = np.stack([_resize_slowly(image, size) for image in images])
    np.testing.assert_array_equal(resize(images, size), expected)


def test_resize_of_a_case_worked_by_hand() -> None:
    """Three pixels become two: each covers one and a half."""
    np.testing.assert_array_equal(resize(np.array([[[30, 60, 0]]], np.uint8), (1, 2)), [[[40, 20]]])


def test_resize_keeps_white_and_black() -> None:
    for value in (0, 255):
        assert (resize(np.full((1, 210, 160), value, np.uint8), (84, 84)) == value).all()


def test_grey_is_the_luma_of_bt_601() -> None:
    images = _noise(2, 5, 7, 3)
    images[0, 0, 0], images[0, 0, 1] = 255, 0
    luma = grey(images)
    assert luma.shape == (2, 5, 7)
    assert luma.dtype == np.uint8
    assert (luma[0, 0, 0], luma[0, 0, 1]) == (255, 0)
    expected = images.astype(np.float64) @ [0.299, 0.587, 0.114]
    assert np.abs(luma - expected).max() < 1.0
    by_256ths = np.floor(images.astype(np.float64) @ [77 / 256, 150 / 256, 29 / 256] + 0.5)
    np.testing.assert_array_equal(luma, by_256ths)


def test_crop_removes_pixels_at_the_top_bottom_left_and_right() -> None:
    images = _noise(2, 6, 8, 3)
    np.testing.assert_array_equal(crop(images, (1, 2, 0, 3)), images[:, 1:4, 0:5])
    np.testing.assert_array_equal(crop(images, (0, 0, 0, 0)), images)


def test_transforms_are_applied_in_order() -> None:
    spec = EnvironmentSpec(id="x", crop=(0, 2, 1, 1), grey=True, resize=(2, 3))
    pixels = Pixels(spec, _space(6, 8, 3))
    images = _noise(4, 6, 8, 3)
    assert pixels.shape == (2, 3)
    np.testing.assert_array_equal(pixels(images), resize(grey(images[:, :4, 1:7]), (2, 3)))


def test_colours_may_come_first() -> None:
    spec = EnvironmentSpec(id="x", crop=(0, 2, 1, 1), resize=(4, 5))
    pixels = Pixels(spec, _space(3, 10, 12))
    images = _noise(4, 10, 12, 3)
    assert pixels.shape == (3, 4, 5)
    expected = resize(images[:, :8, 1:11], (4, 5))
    np.testing.assert_array_equal(pixels(images.transpose(0, 3, 1, 2)), expected.transpose(0, 3, 1, 2))
    luma = Pixels(EnvironmentSpec(id="x", grey=True), _space(3, 10, 12))(images.transpose(0, 3, 1, 2))
    np.testing.assert_array_equal(luma, grey(images))


@pytest.mark.parametrize(
    ("shape", "image"),
    [
        ((20, 30, 3), (3, 20, 30)),
        ((3, 20, 30), (3, 20, 30)),
        ((84, 84, 4), (4, 84, 84)),
        ((16, 16, 27), (27, 16, 16)),  # a board with more planes than rows
        ((27, 16, 16), (27, 16, 16)),
        ((16, 16, 16), (16, 16, 16)),
    ],
)
def test_equal_neighbouring_axes_are_height_and_width(shape: tuple[int, ...], image: tuple[int, ...]) -> None:
    assert ArraySpace(shape=shape, dtype="uint8").image_shape == image
    assert Pixels(EnvironmentSpec(id="x", resize=(5, 6)), _space(*shape)).shape in ((image[0], 5, 6), (5, 6, image[0]))


@pytest.mark.parametrize("frame", [(20, 30, 3), (3, 20, 30), (20, 30), (20, 30, 1), (1, 20, 30)])
@pytest.mark.parametrize("crop_margins", [None, (1, 2, 3, 4)])
@pytest.mark.parametrize("is_grey", [False, True])
@pytest.mark.parametrize("size", [None, (5, 6), (50, 60)])
def test_shape_is_that_of_the_transformed_frames(
    frame: tuple[int, ...], crop_margins: tuple[int, int, int, int] | None, is_grey: bool, size: tuple[int, int] | None
) -> None:
    spec = EnvironmentSpec(id="x", crop=crop_margins, grey=is_grey, resize=size)
    try:
        pixels = Pixels(spec, _space(*frame))
    except EnvironmentSetupError:
        assert is_grey
        assert 3 not in frame
        return
    assert pixels(_noise(2, *frame)).shape == (2, *pixels.shape)


def test_largest_array_of_the_transforms_is_known_before_it_is_allocated() -> None:
    """Enlarging the height gives an array of float32 with the new height and the old width."""
    tall = Pixels(EnvironmentSpec(id="x", resize=(84, 84)), _space(4, 1_000_000))
    assert tall.shape == (84, 84)
    assert tall.largest_bytes == 84 * 1_000_000 * 4
    assert Pixels(EnvironmentSpec(id="x", grey=True, resize=(84, 84)), _space(3, 96, 100)).largest_bytes == 84 * 100 * 4
    assert Pixels(EnvironmentSpec(id="x", resize=(8, 8)), _space(96, 100, 3)).largest_bytes == 96 * 100 * 3


def test_construction_allocates_no_frame() -> None:
    spec = EnvironmentSpec(id="x", crop=(0, 1, 0, 0), grey=True, resize=(84, 84))
    space = _space()
    space._shape = (16, 1_300_000, 3)
    tracemalloc.start()
    try:
        assert Pixels(spec, space).shape == (84, 84)
        assert tracemalloc.get_traced_memory()[1] < 1 << 20
    finally:
        tracemalloc.stop()


def test_frames_pass_unchanged_without_transforms() -> None:
    pixels = Pixels(EnvironmentSpec(id="x"), _space(4, dtype=np.float32))
    frames = np.ones((2, 4), np.float32)
    assert pixels.shape == (4,)
    assert pixels(frames) is frames


@pytest.mark.parametrize(
    ("transform", "space", "reason"),
    [
        ({"crop": (3, 3, 0, 0)}, _space(6, 8, 3), "leave nothing of 6 x 8 pixels"),
        ({"crop": (0, 0, 4, 5)}, _space(6, 8), "leave nothing of"),
        ({"crop": (1, 1, 1, 1)}, _space(6), r"images of shape \(H, W\)"),
        ({"grey": True}, _space(6, 8), r"shape \(6, 8\) is not RGB"),
        ({"grey": True}, _space(6, 8, 1), "is not RGB"),
        ({"grey": True}, _space(6, 8, 3, dtype=np.float32), "uint8 images"),
        ({"resize": (2, 2)}, _space(2, 6, 8, 3), "uint8 images"),
    ],
)
def test_transform_that_does_not_fit_is_reported_with_the_space(
    transform: dict, space: gymnasium.spaces.Box, reason: str
) -> None:
    name = next(iter(transform))
    with pytest.raises(EnvironmentSetupError, match=rf"environment\.{name}.* observation space Box.*: .*{reason}"):
        Pixels(EnvironmentSpec(id="x", **transform), space)
