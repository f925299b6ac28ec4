"""Shapes and dtypes that messages may have; compact weights."""

import warnings
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays

from daedalus.protocol.compact import bfloat16, bits_of, float32, planes
from daedalus.protocol.messages import EvaluationReport
from daedalus.protocol.uploads import Rollout, RolloutIdentity

T, E, K = 3, 2, 1


def rollout(**changed: Any) -> Rollout:
    arrays: dict[str, Any] = {
        "frames": {"observation": np.zeros((T + 1, E, 4), np.float32)},
        "initial_state": np.zeros((E, 5), np.float32),
        "actions": {"action": np.zeros((T, E, 1), np.int64)},
        "masks": {},
        "behaviour_log_probs": np.zeros((T, E), np.float32),
        "rewards": np.zeros((T, E), np.float32),
        "terminated": np.zeros((T, E), np.bool_),
        "truncated": np.zeros((T, E), np.bool_),
        "valid": np.ones((T, E), np.bool_),
        "episode_returns": np.zeros(K, np.float32),
        "episode_lengths": np.ones(K, np.int32),
    }
    identity = RolloutIdentity(actor="a", incarnation=1, sequence=0, learner_epoch=1)
    return Rollout(identity=identity, policy_version=0, **(arrays | changed))


@pytest.mark.parametrize(
    "changed",
    [
        {},
        {"episode_returns": np.zeros(T * E, np.float32), "episode_lengths": np.ones(T * E, np.int32)},  # in every row
        {"episode_returns": np.zeros(0, np.float32), "episode_lengths": np.zeros(0, np.int32)},
        {"episode_returns": np.full(K, 16_777_217, np.float64)},
        {"initial_state": np.zeros((E, 0), np.float32)},
        *(
            {"frames": {"a": np.zeros(shape, np.uint8)}}
            for shape in [(T + 1, E, 4), (T + 4, E, 4), (T + 4, E, 8, 8, 3)]
        ),
        {"episode_info": {"x" * 64: np.zeros(K, np.float32), "lap.time_s-1": np.zeros(1, np.float64)}},
    ],
)
def test_rollout_is_accepted_as_it_is(changed: dict[str, Any]) -> None:
    made = rollout(**changed)
    assert (made.rows, made.environments) == (T, E)
    for name, value in changed.items():
        assert getattr(made, name) is value


ROW_ARRAYS = ("behaviour_log_probs", "rewards", "terminated", "truncated", "valid")


WRONG_FRAMES = [(T, E, 4), (T + 1, E + 1, 4), (T + 1, E), (E, T + 1, 4), (0, E, 4), ()]
WRONG_STATES = [(E + 1, 5), (E,), (T, E, 5), ()]
WRONG_ACTIONS = [(), (T,), (T, E), (T, E + 1, 1), (T + 1, E, 1), (T, E, 1, 1)]
WRONG_EPISODES = [(), (K + 1,), (K, 1)]
MANY = T * E + 1


@pytest.mark.parametrize(
    ("changed", "reason"),
    [
        *(
            ({"frames": {"camera": np.zeros(shape, np.float32)}}, r"^frames/camera must be \[4 or more, 2, ...\]")
            for shape in WRONG_FRAMES
        ),
        *(
            ({"initial_state": np.zeros(shape, np.float32)}, r"^initial_state must be \[2, S\]")
            for shape in WRONG_STATES
        ),
        *(
            ({"actions": {"a": np.zeros(shape, np.float32)}}, r"^actions/a must be \[3, 2, D\]")
            for shape in WRONG_ACTIONS
        ),
        *(({"masks": {"a": np.zeros(shape, np.bool_)}}, r"^masks/a must be \[3, 2, D\]") for shape in WRONG_ACTIONS),
        *(({name: {}}, "must have observations and actions") for name in ("frames", "actions")),
        *(
            ({"actions": {"a": np.zeros((T, E, 1), dtype)}}, "^actions/a must be float32 or integers")
            for dtype in (np.float64, np.bool_, np.float16)
        ),
        ({"masks": {"a": np.ones((T, E, 4), np.uint8)}}, "^masks/a must be bool"),
        *(
            ({"rewards": np.zeros(shape, np.float32)}, "at least one row and one environment")
            for shape in [(0, E), (T, 0)]
        ),
        ({"episode_lengths": np.ones(K, np.float32)}, "episode_lengths.* integers"),
        *(({"episode_returns": np.zeros(shape, np.float32)}, "returns and episode_l") for shape in WRONG_EPISODES),
        *(({"episode_lengths": np.zeros(shape, np.int32)}, "returns and episode_l") for shape in WRONG_EPISODES),
        *(
            ({"episode_returns": np.zeros(K, dtype)}, "^episode_returns must be float64 or float32")
            for dtype in (np.int64, np.float16)
        ),
        (
            {"episode_returns": np.zeros(MANY, np.float32), "episode_lengths": np.ones(MANY, np.int32)},
            "more episodes ended",
        ),
    ],
)
def test_array_of_another_shape_or_dtype_is_refused(changed: dict[str, Any], reason: str) -> None:
    with pytest.raises(ValueError, match=reason):
        rollout(**changed)


@pytest.mark.parametrize("name", [name for name in ROW_ARRAYS if name != "rewards"])
@pytest.mark.parametrize("shape", [(T,), (T + 1, E), (T, E + 1), (E, T), (T, E, 1), (0, E), ()])
def test_array_of_another_shape_than_rewards_is_named(name: str, shape: tuple[int, ...]) -> None:
    dtype = getattr(rollout(), name).dtype
    with pytest.raises(ValueError, match=f"^{name} must be"):
        rollout(**{name: np.zeros(shape, dtype)})


@pytest.mark.parametrize("name", [*ROW_ARRAYS, "initial_state"])
@pytest.mark.parametrize("dtype", [np.uint8, np.int64, np.float64])
def test_array_of_the_wrong_dtype_is_named(name: str, dtype: type) -> None:
    right = getattr(rollout(), name)
    with pytest.raises(ValueError, match=f"^{name} must be {right.dtype}"):
        rollout(**{name: right.astype(dtype)})


@pytest.mark.parametrize(
    ("info", "message"),
    [
        ({"": np.zeros(1, np.float32)}, "must be 1 to 64 letters"),
        ({"x" * 65: np.zeros(1, np.float32)}, "must be 1 to 64 letters"),
        ({"a/b": np.zeros(1, np.float32)}, "must be 1 to 64 letters"),
        ({"\x1b[31m": np.zeros(1, np.float32)}, "must be 1 to 64 letters"),
        ({"a": np.zeros(1, np.int32)}, "float32"),
        ({"a": np.zeros((1, 1), np.float32)}, "float32"),
        ({"a": np.zeros(0, np.float32)}, "from 1 to"),
        ({"a": np.zeros(K + 1, np.float32)}, "from 1 to"),
        ({f"a{number}": np.zeros(1, np.float32) for number in range(17)}, "17 names"),
    ],
)
def test_rollout_with_wrong_episode_info_is_refused(info: dict[str, np.ndarray], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        rollout(episode_info=info)


def test_at_most_256_values_of_a_name_travel() -> None:
    rows = {name: np.zeros((300, 1), getattr(rollout(), name).dtype) for name in ROW_ARRAYS}
    long: dict[str, Any] = {
        **rows,
        "frames": {"observation": np.zeros((301, 1, 4), np.float32)},
        "actions": {"action": np.zeros((300, 1, 1), np.int64)},
        "initial_state": np.zeros((1, 0), np.float32),
        "episode_returns": np.zeros(300, np.float32),
        "episode_lengths": np.ones(300, np.int32),
    }
    assert rollout(**long, episode_info={"a": np.zeros(256, np.float32)}).rows == 300
    with pytest.raises(ValueError, match="from 1 to 256"):
        rollout(**long, episode_info={"a": np.zeros(257, np.float32)})


def report(returns: np.ndarray, lengths: np.ndarray) -> EvaluationReport:
    return EvaluationReport(evaluator="e", learner_epoch=1, policy_version=2, returns=returns, lengths=lengths)


def test_report_has_a_length_for_each_return() -> None:
    report(np.zeros(3, np.float32), np.ones(3, np.int32))
    for returns, lengths in ((3, 2), (0, 0), ((3, 1), (3, 1)), ((), ())):
        with pytest.raises(ValueError, match=r"^returns and lengths must both be \[K\], with K at least 1"):
            report(np.zeros(returns, np.float32), np.ones(lengths, np.int32))


@pytest.mark.parametrize(("returns", "lengths"), [("f2", "i4"), ("i4", "i4"), ("f4", "f4"), ("f8", "i8")])
def test_report_of_other_dtypes_is_rejected(returns: str, lengths: str) -> None:
    with pytest.raises(ValueError, match=r"^returns must be float64 or float32, and lengths int32"):
        report(np.zeros(3, returns), np.ones(3, lengths))


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
