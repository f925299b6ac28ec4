"""The backend `envpool`, compared with a pool whose environments are stepped one by one."""

import sys
import warnings
from types import SimpleNamespace
from typing import Any

import gymnasium
import numpy as np
import pytest
from plain import PlainEnvironments, choices

from daedalus.actor.environments.environment_errors import EnvironmentSetupError
from daedalus.actor.environments.envpool_backend import EnvpoolEnvironments, make_envpool
from daedalus.actor.environments.make import make_environments
from daedalus.protocol.spec import EnvironmentSpec

GAS = ((0.0, 1.0, 0.0), (0.0, 0.0, 0.0), (-1.0, 0.5, 0.0), (1.0, 0.0, 0.5))


@pytest.fixture(autouse=True, scope="module")
def _installed() -> None:
    """Import envpool, which takes a second, in one worker only."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)
        pytest.importorskip("envpool")


def _spec(name: str, **fields) -> EnvironmentSpec:
    return EnvironmentSpec(id=name, backend="envpool", **fields)


class _OneByOne:
    """The slow oracle: each environment of an identical pool is stepped and reset individually."""

    def __init__(self, name: str, count: int, seed: int, repeat: int, limit: int) -> None:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)
            import envpool

            self._pool = envpool.make_gymnasium(name, num_envs=count, num_threads=1, seed=seed, max_episode_steps=limit)
            self.first = self._pool.reset()[0]
        self._repeat = repeat
        self._ended = [False] * count

    def step(self, environment: int, action: np.ndarray) -> tuple[Any, float, bool, bool]:
        total, frame, terminated, truncated = 0.0, None, False, False
        for _ in range(1 if self._ended[environment] else self._repeat):
            frames, rewards, over, cut, info = self._pool.step(action[None], np.array([environment], np.int32))
            assert (info["elapsed_step"][0] == 0) == self._ended[environment]
            frame, terminated, truncated = _row(frames, 0), bool(over[0]), bool(cut[0])
            total += float(rewards[0])
            if terminated or truncated:
                break
        self._ended[environment] = terminated or truncated
        assert frame is not None
        return frame, total, terminated, truncated


def _row(frames: Any, row: int) -> Any:
    """Return one row of an observation, which may be a nested map of components."""
    return {name: _row(part, row) for name, part in frames.items()} if isinstance(frames, dict) else frames[row]


@pytest.mark.parametrize(
    ("name", "table", "limit", "rows"), [("CartPole-v1", None, 18, 100), ("CarRacing-v3", GAS, 11, 12)]
)
@pytest.mark.parametrize("repeat", [1, 4])
def test_repeated_actions_equal_single_steps(
    name: str, table: tuple | None, limit: int, rows: int, repeat: int
) -> None:
    """Frames, rewards and ends of every row, including reset rows and ends in the middle of a repeat."""
    count = 3
    environments = PlainEnvironments(
        make_environments(_spec(name, action_repeat=repeat, max_episode_steps=limit, action_table=table), 3)
    )
    oracle = _OneByOne(name, count, seed=5, repeat=repeat, limit=limit)
    np.testing.assert_array_equal(environments.reset(5), oracle.first)
    actions = np.random.default_rng(1).integers(0, choices(environments.spaces), (rows, count))
    ends = np.zeros(2, np.int64)
    for row in actions:
        chosen = np.asarray(table, np.float32)[row] if table else row
        expected = zip(*(oracle.step(e, chosen[e]) for e in range(count)), strict=True)
        step = environments.step(row)
        for ours, theirs in zip(step, expected, strict=True):
            np.testing.assert_array_equal(ours, np.stack(theirs))
        ends += step[2].sum(), step[3].sum()
    assert ends[1] > 0
    assert ends[0] > 0 or name == "CarRacing-v3"
    environments.close()


@pytest.mark.parametrize("name", ["CheetahRun-v1", "MiniGrid-Empty-5x5-v0", "Maze-v0"])
@pytest.mark.parametrize("repeat", [1, 2])
def test_composite_observations_equal_single_steps(name: str, repeat: int) -> None:
    count, limit = 3, 5
    spec = _spec(name, action_repeat=repeat, max_episode_steps=limit)
    bare, _ = make_envpool(spec, count)
    oracle = _OneByOne(name, count, seed=5, repeat=repeat, limit=limit)
    np.testing.assert_equal(bare.reset(5), oracle.first)
    bare.action_space.seed(1)
    ends = 0
    for _ in range(12):
        actions = np.stack([bare.action_space.sample() for _ in range(count)])
        frames, _, terminated, truncated = bare.step(actions)
        for environment, action in enumerate(actions):
            frame, _, over, cut = oracle.step(environment, action)
            np.testing.assert_equal(_row(frames, environment), frame)
            assert (terminated[environment], truncated[environment]) == (over, cut)
        ends += (terminated | truncated).sum()
    assert ends or name == "Maze-v0"
    bare.close()


def test_components_of_composite_observations_are_those_of_the_pool() -> None:
    environments = make_environments(_spec("MiniGrid-Empty-5x5-v0"), 2)
    frames = environments.reset(1).frames
    assert {name: values.shape for name, values in frames.items()} == {
        "direction": (2, 1),
        "image": (2, 7, 7, 3),
        "mission": (2, 96),
    }
    environments.close()


def test_episode_that_no_reward_limit_ends_resets_at_the_next_step() -> None:
    """MountainCar rewards every step with -1 and starts at rest, between -0.6 and -0.4."""
    environments = PlainEnvironments(make_environments(_spec("MountainCar-v0", no_reward_limit=3, action_repeat=2), 2))
    environments.reset(1)
    for row in range(1, 13):
        frames, rewards, terminated, truncated = environments.step(np.array([2, 0]))
        starts = row % 4 == 0
        assert (frames[:, 1] == 0.0).all() == starts
        assert rewards.tolist() == ([0.0, 0.0] if starts else [-2.0, -2.0])
        assert truncated.tolist() == [row % 4 == 3] * 2
        assert terminated.tolist() == truncated.tolist(), "nothing more is to come"
    environments.close()


def test_no_reward_limit_is_counted_per_environment() -> None:
    """The first environment drives over tiles, the second stands still."""
    environments = PlainEnvironments(
        make_environments(_spec("CarRacing-v3", no_reward_limit=4, action_repeat=4, action_table=GAS), 2)
    )
    environments.reset(1)
    cuts = np.stack([environments.step(np.array([0, 1]))[3] for _ in range(6)])
    environments.close()
    assert np.flatnonzero(cuts[:, 1]).tolist() == [4], "the first step rewards the tile under the car"
    assert not cuts[:4, 0].any()


class _ThreeSteps:
    """The part of envpool that is needed for a pool of one environment, without rewards and with three steps."""

    def make_spec(self, _name: str, **_options) -> SimpleNamespace:
        space = gymnasium.spaces.Box(0, 9, (1,), np.float32)
        return SimpleNamespace(gymnasium_observation_space=space, gymnasium_action_space=gymnasium.spaces.Discrete(2))

    def make_gymnasium(self, _name: str, **_options) -> "_ThreeSteps":
        return self

    def reset(self, _ids: np.ndarray | None = None) -> tuple[np.ndarray, dict]:
        self._steps = 0
        return np.zeros((1, 1), np.float32), {}

    def step(self, _actions: np.ndarray, _ids: np.ndarray) -> tuple:
        self._steps += 1
        return np.full((1, 1), self._steps), np.zeros(1), np.array([self._steps == 3]), np.array([False]), {}


@pytest.mark.parametrize(("no_reward_limit", "terminates", "truncates"), [(4, [2], []), (3, [2], []), (2, [1], [1])])
def test_termination_takes_precedence_over_no_reward_limit(
    no_reward_limit: int, terminates: list, truncates: list
) -> None:
    environments = EnvpoolEnvironments(_ThreeSteps(), "x", {"num_envs": 1}, no_reward_limit=no_reward_limit)
    environments.reset(1)
    rows = [environments.step(np.zeros(1, np.int64)) for _ in range(3)]
    assert [row for row, (_, _, terminated, _) in enumerate(rows) if terminated[0]] == terminates
    assert [row for row, (_, _, _, truncated) in enumerate(rows) if truncated[0]] == truncates


def test_car_racing_episode_has_a_thousand_frames() -> None:
    environments = PlainEnvironments(make_environments(_spec("CarRacing-v3", action_repeat=64, action_table=GAS), 1))
    environments.reset(1)
    cuts = [bool(environments.step(np.array([1]))[3][0]) for _ in range(17)]
    environments.close()
    assert cuts == [False] * 15 + [True, False]  # 15 x 64 + 40


def test_car_racing_has_the_same_spaces_as_with_gymnasium() -> None:
    table = (
        *((steer, gas, 0.0) for steer in (-1.0, -0.5, 0.0, 0.5, 1.0) for gas in (0.0, 0.5)),
        (0, 0, 0.2),
        (0, 0, 0.8),
    )
    fields = {"action_table": table, "action_repeat": 2, "crop": (0, 12, 6, 6), "grey": True, "frame_stack": 4}
    shown = {}
    for backend in ("gymnasium", "envpool"):
        environments = PlainEnvironments(
            make_environments(EnvironmentSpec(id="CarRacing-v3", backend=backend, **fields), 2)
        )
        first = environments.reset(1)
        frames = environments.step(np.array([0, 11]))[0]
        shown[backend] = environments.spaces, first.shape, first.dtype, frames.shape, frames.dtype
        environments.close()
    assert shown["gymnasium"] == shown["envpool"]
    spaces, shape, dtype, _, _ = shown["envpool"]
    assert (
        spaces.observations["observation"].shape,
        spaces.observations["observation"].frames,
        choices(spaces),
    ) == ((84, 84), 4, 12)
    assert (shape, dtype) == ((2, 84, 84), np.uint8)


@pytest.mark.parametrize(
    ("fields", "shape"),
    [
        ({"grey": True, "resize": (84, 84)}, (84, 84)),
        ({"grey": True}, (210, 160)),
        ({}, (210, 160, 3)),
        ({"resize": (50, 40)}, (50, 40, 3)),
        ({"grey": True, "crop": (34, 16, 0, 0), "resize": (80, 80)}, (80, 80)),
    ],
)
def test_atari_frames_are_single_and_have_the_specified_shape(fields: dict, shape: tuple[int, ...]) -> None:
    environments = PlainEnvironments(make_environments(_spec("Pong-v5", frame_stack=4, action_repeat=4, **fields), 2))
    assert environments.spaces.observations["observation"].shape == shape
    assert environments.reset(1).shape == (2, *shape)
    frames, rewards, _, _ = environments.step(np.zeros(2, np.int64))
    assert (frames.shape, frames.dtype, rewards.shape) == ((2, *shape), np.uint8, (2,))
    environments.close()


def test_atari_episode_limit_counts_frames() -> None:
    environments = PlainEnvironments(make_environments(_spec("Pong-v5", action_repeat=4, max_episode_steps=10), 1))
    environments.reset(1)
    assert [bool(environments.step(np.zeros(1, np.int64))[3][0]) for _ in range(5)] == [
        False,
        False,
        True,
        False,
        False,
    ]
    environments.close()


def test_every_seed_is_accepted_and_determines_the_episodes() -> None:
    environments = PlainEnvironments(make_environments(_spec("CartPole-v1"), 2))
    first = environments.reset(2**32 - 1)
    np.testing.assert_array_equal(environments.reset(2**32 - 1), first)
    assert (environments.reset(1) != first).any()
    assert (first[0] != first[1]).any()
    environments.close()


@pytest.mark.parametrize(
    ("spec", "reason"),
    [
        (_spec("CarRacer-v3"), "unknown environment 'CarRacer-v3': did you mean CarRacing-v"),
        (_spec("zzz"), "envpool has none like it"),
        (
            _spec("CartPole-v1", kwargs={"no_such_option": 1}),
            "CartPole-v1 of envpool cannot be created.*no_such_option",
        ),
        (_spec("CartPole-v1", kwargs={"num_threads": 4}), "names num_threads, but other settings"),
        (_spec("Pong-v5", kwargs={"stack_num": 4, "frame_skip": 2}), "names frame_skip and stack_num"),
    ],
)
def test_setup_error_is_one_line(spec: EnvironmentSpec, reason: str) -> None:
    with pytest.raises(EnvironmentSetupError, match=reason) as caught:
        make_environments(spec, 2)
    assert "\n" not in str(caught.value)


def test_missing_envpool_is_reported_with_the_extra_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "envpool", None)
    with pytest.raises(EnvironmentSetupError, match=r'"daedalus-rl\[envpool\]".*--set environment.backend=gymnasium'):
        make_environments(_spec("CartPole-v1"), 1)
