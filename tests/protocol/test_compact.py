"""bfloat16 against torch's, and differences against the weights that they were computed from."""

import warnings

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays

from daedalus.protocol.compact import bfloat16, bits_of, float32, planes

repeatable = settings(max_examples=200, deadline=None, derandomize=True)
shapes = arrays.array_shapes(min_dims=0, max_dims=3, min_side=0, max_side=5)
patterns = arrays.arrays(np.uint32, shapes, elements=st.integers(0, 2**32 - 1))
halves = shapes.flatmap(
    lambda shape: st.tuples(*[arrays.arrays(np.uint16, shape, elements=st.integers(0, 2**16 - 1))] * 2)
)


@repeatable
@given(patterns)
def test_rounding_matches_torch_for_every_bit_pattern(pattern: np.ndarray) -> None:
    weights = np.asarray(pattern.view(np.float32))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # torch warns about read-only arrays
        expected = torch.from_numpy(weights.copy()).bfloat16().float().numpy()
    found = float32(bfloat16({"w": weights}))["w"]
    assert (found.shape, found.dtype) == (weights.shape, np.float32)
    np.testing.assert_array_equal(found, expected)  # NaN equal to NaN


@repeatable
@given(halves, st.booleans())
def test_bits_are_restored_from_planes(pair: tuple[np.ndarray, np.ndarray], whole: bool) -> None:
    bits, base = ({"w": np.asarray(array)} for array in pair)
    there = planes(bits, None if whole else base)
    assert there["w"].shape == (2, *bits["w"].shape)
    assert there["w"].dtype == np.uint8
    back = bits_of(there, None if whole else base)["w"]
    assert (back.shape, back.dtype) == (bits["w"].shape, np.uint16)
    np.testing.assert_array_equal(back, bits["w"])


def test_hand_worked_difference() -> None:
    base = {"w": np.array([5, 5, 0, 0xFFFF], np.uint16)}
    bits = {"w": np.array([5, 4, 0x0102, 0], np.uint16)}  # by 0, -1, 258 and, wrapping around, 1
    assert planes(bits, base)["w"].tolist() == [[0, 0, 2, 0], [0, 1, 4, 2]]
    assert planes(bits, None)["w"].tolist() == [[0, 0, 1, 0], [5, 4, 2, 0]]


def test_small_update_gives_planes_of_mostly_zeros() -> None:
    """Nearly all of the high bytes are 0, which is why planes compress well."""
    random = np.random.default_rng(1)
    weights = random.normal(0, 0.05, 10_000).astype(np.float32)
    step = weights + random.normal(0, 1e-4, 10_000).astype(np.float32)
    there = planes(bfloat16({"w": step}), bfloat16({"w": weights}))["w"]
    assert np.mean(there[0] == 0) > 0.95


@pytest.mark.parametrize(
    "damaged",
    [
        {"w": np.zeros((2, 4), np.uint8)},
        {"w": np.zeros((2, 3), np.uint8), "v": np.zeros((2, 1), np.uint8)},
        {},
        {"w": np.zeros((3, 3), np.uint8)},
        {"w": np.zeros((2, 3), np.uint16)},
        {"w": np.zeros((), np.uint8)},
    ],
)
def test_planes_that_do_not_fit_the_base_are_rejected(damaged: dict[str, np.ndarray]) -> None:
    with pytest.raises(ValueError, match=r"other names or shapes|must be uint8"):
        bits_of(damaged, {"w": np.zeros(3, np.uint16)})


def test_other_dtypes_are_rejected() -> None:
    with pytest.raises(ValueError, match="'w' has dtype float64"):
        bfloat16({"w": np.zeros(3)})
