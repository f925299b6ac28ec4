"""gymnasium's environments: repeats, no_reward_limit, wrappers, cameras and processes."""

import os
import signal
import sys
from types import SimpleNamespace

import gymnasium
import numpy as np
import pytest
from gymnasium.envs.registration import EnvSpec
from picture_environment import Picture

from daedalus.actor.environments.environment_errors import EnvironmentSetupError
from daedalus.actor.environments.environment_processes import EnvironmentProcesses
from daedalus.actor.environments.gymnasium_backend import EnvironmentFactory, RepeatedSteps
from daedalus.actor.environments.interface import VectorEnvironment
from daedalus.actor.environments.make import make_environments
from daedalus.protocol.spec import EnvironmentSpec

TABLE = ((-1.0, 0.5), (0.0, 0.0), (0.0, 0.5))  # rewards -0.5, 0 and 0.5


def _counting(**fields) -> EnvironmentSpec:
    return EnvironmentSpec(id="counting_environment:Counting-v0", **fields)


def _picture(**fields) -> EnvironmentSpec:
    return EnvironmentSpec(id="picture_environment:Picture-v0", action_table=TABLE, **fields)


def _rows(environments: VectorEnvironment, actions: list[int]) -> list[tuple]:
    """(frame, reward, terminated, truncated) of the first environment for each action in turn."""
    rows = []
    for action in actions:
        frames, rewards, terminated, truncated = environments.step(np.full(environments.count, action))
        rows.append((frames[0].tolist(), round(float(rewards[0]), 4), bool(terminated[0]), bool(truncated[0])))
    return rows


@pytest.mark.parametrize("processes", [False, True])
def test_repeats_sum_rewards_and_stop_at_an_episodes_end(processes: bool) -> None:
    """Counting's episodes have 3 steps (terminated), 2 (truncated) and 1 (terminated), and rewards that tell them."""
    environments = make_environments(_counting(action_repeat=2, processes=processes), 2)
    try:
        assert environments.reset(1).tolist() == [[0.0, 0.0]] * 2
        assert _rows(environments, [1, 0, 3, 0, 0, 2, 0]) == [
            ([0.0, 2.0], 1.2, False, False),  # 0 + 1, and twice a tenth of the action
            ([0.0, 3.0], 2.0, True, False),  # one step was left
            ([1.0, 0.0], 0.0, False, False),  # the reset row
            ([1.0, 2.0], 21.0, False, True),
            ([2.0, 0.0], 0.0, False, False),
            ([2.0, 1.0], 20.2, True, False),
            ([3.0, 0.0], 0.0, False, False),
        ]
    finally:
        environments.close()


def test_the_limit_is_in_the_environments_own_steps() -> None:
    environments = make_environments(_counting(action_repeat=2, max_episode_steps=5, kwargs={"ends": [100]}), 1)
    environments.reset(1)
    assert _rows(environments, [0] * 4) == [
        ([0.0, 2.0], 1.0, False, False),
        ([0.0, 4.0], 5.0, False, False),
        ([0.0, 5.0], 4.0, False, True),
        ([1.0, 0.0], 0.0, False, False),
    ]


def test_patience_cuts_an_episode_after_steps_without_a_positive_reward() -> None:
    environments = make_environments(_picture(no_reward_limit=2, kwargs={"end": 100}), 1)
    environments.reset(1)
    bad, nothing, good = 0, 1, 2
    rows = _rows(environments, [bad, good, nothing, bad, good, nothing, nothing, good])
    assert [row[1] for row in rows] == [-0.5, 0.5, 0.0, -0.5, 0.0, 0.0, 0.0, 0.0]
    assert [row[3] for row in rows] == [False, False, False, True, False, False, True, False]
    assert [tuple(row[0][0][0][:2]) for row in rows[3:6]] == [(0, 4), (1, 0), (1, 1)]
    assert not any(row[2] for row in rows)


def test_patience_counts_rows_and_starts_anew_with_each_episode() -> None:
    """Episodes of 3 steps repeated twice are 2 rows: a no_reward_limit of 2 is reached just where they end."""
    for no_reward_limit, cut in ((3, False), (2, False), (1, True)):
        environments = make_environments(
            _picture(no_reward_limit=no_reward_limit, action_repeat=2, kwargs={"end": 3}), 1
        )
        environments.reset(1)
        rows = _rows(environments, [0] * 9)
        assert any(row[3] for row in rows) == cut, no_reward_limit
        assert any(row[2] for row in rows) != cut, "an end of the environment's own stays one"


def test_a_second_reset_starts_everything_anew() -> None:
    environments = make_environments(_picture(no_reward_limit=3, kwargs={"end": 4}), 2)
    first = [environments.reset(7)]
    first += [environments.step(np.array([0, 2]))[0] for _ in range(2)]
    again = [environments.reset(7)]
    again += [environments.step(np.array([0, 2]))[0] for _ in range(2)]
    first, again = np.stack(first), np.stack(again)
    assert (first[:, :, 0, 0, 0] == 0).all()
    assert (again[:, :, 0, 0, 0] == 1).all()
    np.testing.assert_array_equal(first[:, :, 1:], again[:, :, 1:])
    _, _, terminated, truncated = environments.step(np.array([0, 2]))
    assert (terminated.tolist(), truncated.tolist()) == ([False, False], [True, False])


# ---------------------------------------------------------------------------------------------- wrap, camera


def test_a_wrapper_comes_before_the_repeats() -> None:
    wrap = "picture_environment:with_doubled_rewards"
    environments = make_environments(_counting(action_repeat=2), 1, wrap=wrap)
    environments.reset(1)
    assert _rows(environments, [0, 0])[1] == ([0.0, 3.0], 4.0, True, False)


@pytest.mark.parametrize(
    ("wrap", "reason"),
    [
        ("no_such_module:function", "cannot import no_such_module"),
        ("picture_environment:no_such_function", "no such function"),
        ("picture_environment", "name it as module:function"),
        ("picture_environment:with_nothing_to_play", "made str of .*must be a gymnasium.Env"),
    ],
)
def test_a_wrapper_that_is_none_is_told(wrap: str, reason: str) -> None:
    with pytest.raises(EnvironmentSetupError, match=f"wrap {wrap}.*{reason}"):
        make_environments(_picture(), 1, wrap=wrap)


def test_a_camera_sees_every_step_of_the_environments_own() -> None:
    film: list[np.ndarray] = []
    spec = _picture(action_repeat=3, kwargs={"end": 4}, processes=True, crop=(1, 1, 1, 1))
    environments = make_environments(spec, 1, render_mode="rgb_array", camera=film.append)
    environments.reset(1)
    _rows(environments, [0, 0, 0, 0])
    assert [int(picture[0, 0, 0]) for picture in film] == [0, 1, 2, 3, 4, 0, 1, 2, 3]
    assert film[0].shape == (2, 2, 3)


def test_a_camera_wants_one_environment() -> None:
    with pytest.raises(ValueError, match="a camera films one environment"):
        make_environments(_picture(), 2, render_mode="rgb_array", camera=lambda _: None)


def test_what_shows_no_picture_cannot_be_filmed() -> None:
    class Dark(Picture):
        def render(self) -> None:  # type: ignore[override] - what is wrong with it
            return None

    with pytest.raises(EnvironmentSetupError, match="renders no picture, but NoneType"):
        RepeatedSteps(Dark(), repeat=1, no_reward_limit=None, camera=lambda _: None).reset()


# ------------------------------------------------------------------------------------------------- processes


def test_processes_play_what_one_process_plays() -> None:
    spec = _picture(action_repeat=2, no_reward_limit=2, grey=True, crop=(1, 0, 0, 1), kwargs={"end": 9})
    actions = np.random.default_rng(3).integers(0, 3, (25, 3))
    played = []
    for processes in (False, True):
        environments = make_environments(spec.model_copy(update={"processes": processes}), 3)
        try:
            steps = [environments.step(row) for row in actions] if environments.reset(11) is not None else []
        finally:
            environments.close()
        played.append([np.stack(part) for part in zip(*steps, strict=True)])
    for here, there in zip(*played, strict=True):
        np.testing.assert_array_equal(here, there)
    assert played[0][2].any() or played[0][3].any(), "some episodes ended"


def _processes(**fields) -> EnvironmentProcesses:
    return EnvironmentProcesses([EnvironmentFactory(spec=_counting(**fields))] * 2)


def test_closing_ends_the_processes() -> None:
    environments = _processes()
    environments.reset(seed=1)
    environments.close()
    assert [process.exitcode for process in environments.processes] == [0, 0]


def test_closing_after_an_interrupted_step_ends_the_processes() -> None:
    """The answers of a step that was not finished lie in the pipes; asking in them would wait for ever."""
    environments = _processes()
    environments.reset(seed=1)
    pipe = environments.parent_pipes[1]

    def interrupted() -> None:
        raise KeyboardInterrupt

    environments.parent_pipes[1] = SimpleNamespace(send=pipe.send, recv=interrupted)  # type: ignore[assignment] - a pipe's two methods
    with pytest.raises(KeyboardInterrupt):
        environments.step(np.zeros(2, np.int64))
    environments.parent_pipes[1] = pipe
    environments.close()
    assert not any(process.is_alive() for process in environments.processes)


def test_a_process_that_was_killed_is_told_and_the_others_end() -> None:
    environments = _processes()
    environments.reset(seed=1)
    environments.processes[0].kill()
    environments.processes[0].join()
    with pytest.raises(EnvironmentSetupError, match="has ended by itself"):
        environments.step(np.zeros(2, np.int64))
    environments.close()
    assert not any(process.is_alive() for process in environments.processes)


@pytest.mark.skipif(not hasattr(signal, "pthread_sigmask"), reason="an interrupt ends a process at once here")
def test_an_interrupt_leaves_the_processes_to_their_parent() -> None:
    environments = _processes()
    try:
        environments.reset(seed=1)
        for process in environments.processes:
            assert process.pid is not None
            os.kill(process.pid, signal.SIGINT)
        environments.step(np.zeros(2, np.int64))
        assert all(process.is_alive() for process in environments.processes)
        assert signal.SIGINT not in signal.pthread_sigmask(signal.SIG_BLOCK, []), "but this one sees it"
    finally:
        environments.close()


# ----------------------------------------------------------------------------------------------- what is named


def test_a_missing_package_is_named_with_the_extra_that_brings_it(monkeypatch: pytest.MonkeyPatch) -> None:
    def fails(**_kwargs) -> gymnasium.Env:
        raise gymnasium.error.DependencyNotInstalled('Box2D is not installed, run `pip install "gymnasium[box2d]"`')

    monkeypatch.setitem(gymnasium.registry, "Fails-v0", EnvSpec("Fails-v0", fails))
    with pytest.raises(EnvironmentSetupError, match=r'pip install "daedalus-rl\[box2d\]"'):
        make_environments(EnvironmentSpec(id="Fails-v0"), 1)
    monkeypatch.setitem(sys.modules, "ale_py", None)
    with pytest.raises(EnvironmentSetupError, match=r'ALE/Pong-v5.*pip install "daedalus-rl\[atari\]"'):
        make_environments(EnvironmentSpec(id="ALE/Pong-v5"), 1)


def test_gymnasiums_atari_games_show_their_own_screen() -> None:
    pytest.importorskip("ale_py")
    spec = EnvironmentSpec(id="ALE/Pong-v5", kwargs={"frameskip": 1}, action_repeat=4, grey=True, resize=(84, 84))
    environments = make_environments(spec, 2)
    assert environments.reset(1).shape == (2, 84, 84)
    assert environments.step(np.zeros(2, np.int64))[0].shape == (2, 84, 84)
    assert environments.spaces.action.count == 6
    environments.close()
    plain = make_environments(EnvironmentSpec(id="ALE/Pong-v5"), 1)
    assert plain.spaces.observation.shape == (210, 160, 3)
    plain.close()
