from typing import Any

import numpy as np
import pytest

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


def test_rollout_has_rows_and_environments() -> None:
    made = rollout()
    assert (made.rows, made.environments) == (T, E)


def test_an_episode_may_end_in_every_row() -> None:
    made = rollout(episode_returns=np.zeros(T * E, np.float32), episode_lengths=np.ones(T * E, np.int32))
    assert len(made.episode_returns) == T * E


def test_rollout_without_ended_episodes_is_valid() -> None:
    made = rollout(episode_returns=np.zeros(0, np.float32), episode_lengths=np.zeros(0, np.int32))
    assert len(made.episode_returns) == 0


ROW_ARRAYS = ("behaviour_log_probs", "rewards", "terminated", "truncated", "valid")


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


@pytest.mark.parametrize("shape", [(T, E, 4), (T + 1, E + 1, 4), (T + 1, E), (E, T + 1, 4), (0, E, 4), ()])
def test_frames_need_at_least_one_row_more_than_actions(shape: tuple[int, ...]) -> None:
    with pytest.raises(ValueError, match=r"^frames/camera must be \[4 or more, 2, ...\]"):
        rollout(frames={"camera": np.zeros(shape, np.float32)})


@pytest.mark.parametrize("shape", [(T + 1, E, 4), (T + 4, E, 4), (T + 4, E, 8, 8, 3)])
def test_frame_stack_adds_frames_before_the_first_row(shape: tuple[int, ...]) -> None:
    assert rollout(frames={"observation": np.zeros(shape, np.uint8)}).rows == T


@pytest.mark.parametrize("shape", [(E + 1, 5), (E,), (T, E, 5), ()])
def test_state_of_another_number_of_environments_is_rejected(shape: tuple[int, ...]) -> None:
    with pytest.raises(ValueError, match=r"^initial_state must be \[2, S\]"):
        rollout(initial_state=np.zeros(shape, np.float32))


def test_state_may_be_empty() -> None:
    assert rollout(initial_state=np.zeros((E, 0), np.float32)).initial_state.shape == (E, 0)


@pytest.mark.parametrize("shape", [(), (T,), (T, E), (T, E + 1, 1), (T + 1, E, 1), (T, E, 1, 1)])
def test_actions_and_masks_of_another_shape_are_rejected(shape: tuple[int, ...]) -> None:
    with pytest.raises(ValueError, match=r"^actions/arm must be \[3, 2, D\]"):
        rollout(actions={"arm": np.zeros(shape, np.float32)})
    with pytest.raises(ValueError, match=r"^masks/gripper must be \[3, 2, D\]"):
        rollout(masks={"gripper": np.zeros(shape, np.bool_)})


def test_a_rollout_needs_observations_and_actions() -> None:
    for name in ("frames", "actions"):
        with pytest.raises(ValueError, match="must have observations and actions"):
            rollout(**{name: {}})


@pytest.mark.parametrize("dtype", [np.float64, np.bool_, np.float16])
def test_actions_are_integers_or_float32(dtype: type) -> None:
    with pytest.raises(ValueError, match=r"^actions/action must be float32 or integers"):
        rollout(actions={"action": np.zeros((T, E, 1), dtype)})


def test_masks_are_bool() -> None:
    with pytest.raises(ValueError, match=r"^masks/action must be bool"):
        rollout(masks={"action": np.ones((T, E, 4), np.uint8)})


@pytest.mark.parametrize(("rows", "environments"), [(0, E), (T, 0)])
def test_empty_rollout_is_rejected(rows: int, environments: int) -> None:
    with pytest.raises(ValueError, match="at least one row and one environment"):
        rollout(rewards=np.zeros((rows, environments), np.float32))


def test_rollout_with_episode_info_is_accepted() -> None:
    info = {"x" * 64: np.zeros(K, np.float32), "lap.time_s-1": np.zeros(1, np.float64)}
    assert rollout(episode_info=info).episode_info == info


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


def test_lengths_must_be_integers() -> None:
    with pytest.raises(ValueError, match=r"episode_lengths.* integers"):
        rollout(episode_lengths=np.ones(K, np.float32))


@pytest.mark.parametrize("shape", [(), (K + 1,), (K, 1)])
def test_returns_and_lengths_must_have_the_same_shape(shape: tuple[int, ...]) -> None:
    with pytest.raises(ValueError, match="episode_returns and episode_lengths"):
        rollout(episode_returns=np.zeros(shape, np.float32))
    with pytest.raises(ValueError, match="episode_returns and episode_lengths"):
        rollout(episode_lengths=np.zeros(shape, np.int32))


def test_more_episodes_than_rows_are_rejected() -> None:
    many = T * E + 1
    with pytest.raises(ValueError, match="more episodes ended"):
        rollout(episode_returns=np.zeros(many, np.float32), episode_lengths=np.ones(many, np.int32))


def report(returns: np.ndarray, lengths: np.ndarray) -> EvaluationReport:
    return EvaluationReport(evaluator="e", learner_epoch=1, policy_version=2, returns=returns, lengths=lengths)


def test_report_has_a_length_for_each_return() -> None:
    report(np.zeros(3, np.float32), np.ones(3, np.int32))
    for returns, lengths in ((3, 2), (0, 0), ((3, 1), (3, 1)), ((), ())):
        with pytest.raises(ValueError, match=r"^returns and lengths must both be \[K\], with K at least 1"):
            report(np.zeros(returns, np.float32), np.ones(lengths, np.int32))


@pytest.mark.parametrize("dtype", [np.int64, np.float16])
def test_returns_must_be_float64_or_float32(dtype: type) -> None:
    for accepted in (np.float32, np.float64):
        assert rollout(episode_returns=np.full(K, 16_777_217, accepted)).episode_returns.dtype == accepted
    with pytest.raises(ValueError, match=r"^episode_returns must be float64 or float32"):
        rollout(episode_returns=np.zeros(K, dtype))


@pytest.mark.parametrize(("returns", "lengths"), [("f2", "i4"), ("i4", "i4"), ("f4", "f4"), ("f8", "i8")])
def test_report_of_other_dtypes_is_rejected(returns: str, lengths: str) -> None:
    with pytest.raises(ValueError, match=r"^returns must be float64 or float32, and lengths int32"):
        report(np.zeros(3, returns), np.ones(3, lengths))
