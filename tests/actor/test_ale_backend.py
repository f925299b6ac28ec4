"""The backend `ale`."""

import sys

import numpy as np
import pytest
from plain import PlainEnvironments, choices

from daedalus.actor.environments.environment_errors import EnvironmentSetupError
from daedalus.actor.environments.make import make_environments
from daedalus.protocol.spec import EnvironmentSpec

pytest.importorskip("ale_py.vector_env")


def _spec(name: str, **fields) -> EnvironmentSpec:
    return EnvironmentSpec(id=name, backend="ale", **fields)


@pytest.mark.parametrize("name", ["Pong", "Pong-v5", "ALE/Pong-v5", "pong"])
def test_game_is_found_by_its_usual_names(name: str) -> None:
    environments = make_environments(_spec(name, grey=True, resize=(84, 84), frame_stack=4), 2)
    assert environments.spaces.observations["observation"].stacked_shape == (4, 84, 84)
    assert choices(environments.spaces) == 6
    environments.close()


def test_game_with_a_name_of_several_words_is_found() -> None:
    environments = make_environments(_spec("ALE/MsPacman-v5"), 1)
    assert choices(environments.spaces) == 9  # eight directions and no move; Pong has 6
    environments.close()


@pytest.mark.parametrize(
    ("fields", "shape"),
    [({}, (210, 160, 3)), ({"grey": True}, (210, 160)), ({"resize": (50, 40)}, (50, 40, 3))],
)
def test_frames_are_single_and_have_the_specified_shape(fields: dict, shape: tuple[int, ...]) -> None:
    environments = PlainEnvironments(make_environments(_spec("Pong", action_repeat=4, **fields), 2))
    first = environments.reset(2**32 - 1)
    before = first.copy()
    frames = environments.step(np.zeros(2, np.int64))[0]
    assert environments.spaces.observations["observation"].shape == shape
    assert (first.shape, frames.shape, frames.dtype) == ((2, *shape), (2, *shape), np.uint8)
    for _ in range(30):
        environments.step(np.full(2, 2))
    np.testing.assert_array_equal(first, before)
    environments.close()


def test_episode_limit_counts_frames_and_the_next_step_resets() -> None:
    environments = PlainEnvironments(
        make_environments(_spec("Pong", action_repeat=4, max_episode_steps=10, grey=True), 2)
    )
    environments.reset(1)
    rows = [environments.step(np.full(2, row % 6)) for row in range(8)]
    assert [truncated.tolist() for _, _, _, truncated in rows] == [[row % 4 == 2] * 2 for row in range(8)]
    assert not any(terminated.any() for _, _, terminated, _ in rows)
    environments.close()


def test_rewards_are_not_clipped() -> None:
    """A target of Space Invaders is worth 5 points or more."""
    environments = PlainEnvironments(
        make_environments(_spec("SpaceInvaders", action_repeat=4, grey=True, resize=(84, 84)), 2)
    )
    environments.reset(1)
    best = max(float(environments.step(np.ones(2, np.int64))[1].max()) for _ in range(300))
    environments.close()
    assert best >= 5.0


@pytest.mark.parametrize(
    ("spec", "reason"),
    [
        (_spec("Ponk"), "unknown environment 'Ponk': did you mean Pong"),
        (_spec("Pong", kwargs={"no_such_option": 1}), "cannot be created.*no_such_option"),
        (_spec("Pong", kwargs={"stack_num": 4}), "cannot be created.*stack_num"),
        (
            _spec("Pong", no_reward_limit=3),
            "does not support environment.no_reward_limit: .*--set environment.backend=gymnasium",
        ),
        (_spec("Pong", crop=(1, 1, 1, 1)), "does not support environment.crop"),
        (_spec("Pong", action_table=((1.0,), (2.0,))), "does not support environment.action_table"),
    ],
)
def test_setup_error_is_one_line(spec: EnvironmentSpec, reason: str) -> None:
    with pytest.raises(EnvironmentSetupError, match=reason) as caught:
        make_environments(spec, 2)
    assert "\n" not in str(caught.value)


def test_missing_ale_is_reported_with_the_extra_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "ale_py.roms", None)
    with pytest.raises(EnvironmentSetupError, match=r'"daedalus-rl\[atari\]".*--set environment.backend=gymnasium'):
        make_environments(_spec("Pong"), 1)
