"""protocol/frames.py against gymnasium's frame stack: the actor's observations and those of the learner."""

from dataclasses import dataclass, field
from typing import Any

import gymnasium
import numpy as np
import pytest
from collectors import started_collector
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from gymnasium.wrappers import FrameStackObservation
from hypothesis import given, settings
from hypothesis import strategies as st
from oracles import stack_rows
from plain import ACTION, NAME, plain_spaces

from daedalus.actor.environments.vector_environments import Observed, Step
from daedalus.policy.acting.noise import Noise, NoiseSize
from daedalus.policy.acting.runtime import Choice
from daedalus.protocol.codec import decode, encode
from daedalus.protocol.frames import FrameStack
from daedalus.protocol.limits import Limits
from daedalus.protocol.spaces import ArraySpace, Spaces
from daedalus.protocol.spec import EnvironmentSpec
from daedalus.protocol.uploads import Rollout, RolloutIdentity

IDENTITY = RolloutIdentity(actor="a", incarnation=1, sequence=0, learner_epoch=1)


class Film(gymnasium.Env[np.ndarray, np.int64]):
    """Environment with a new picture at each step and episodes of given lengths."""

    def __init__(self, space: ArraySpace, number: int, lengths: list[int]) -> None:
        self.observation_space = gymnasium.spaces.Box(0, 255, space.shape, np.dtype(space.dtype).type)
        self.action_space = gymnasium.spaces.Discrete(2)
        self._random = np.random.default_rng(number)
        self._lengths, self._episode, self._step = lengths, -1, 0

    def _observe(self) -> np.ndarray:
        return self._random.integers(0, 256, self.observation_space.shape).astype(self.observation_space.dtype)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[np.ndarray, dict]:
        super().reset(seed=seed)
        self._episode, self._step = self._episode + 1, 0
        return self._observe(), {}

    def step(self, action: np.int64) -> tuple[np.ndarray, float, bool, bool, dict]:
        self._step += 1
        over = self._step == self._lengths[self._episode % len(self._lengths)]
        return self._observe(), 1.0, over and self._episode % 2 == 0, over and self._episode % 2 == 1, {}


@dataclass
class Films:
    """E of these environments with the interface that the collector takes."""

    space: ArraySpace
    lengths: list[list[int]]
    stacked: bool = False
    played: SyncVectorEnv = field(init=False)
    seats: int = 1
    games: None = None

    def __post_init__(self) -> None:
        self.played = SyncVectorEnv(
            [lambda number=number: self._make(number) for number in range(self.count)],
            autoreset_mode=AutoresetMode.NEXT_STEP,
        )

    def _make(self, number: int) -> gymnasium.Env:
        film = Film(self.space, number, self.lengths[number])
        return FrameStackObservation(film, self.space.frames, padding_type="reset") if self.stacked else film

    @property
    def count(self) -> int:
        return len(self.lengths)

    @property
    def spaces(self) -> Spaces:
        return plain_spaces(self.space, 2)

    def reset(self, seed: int) -> Observed:
        return Observed({NAME: self.played.reset(seed=seed)[0]}, {})

    def set_parameters(self, parameters: Any) -> None:
        raise AssertionError("the run has no parameters")

    def take_episode_info(self) -> dict[str, np.ndarray]:
        return {}

    def step(self, actions: dict[str, np.ndarray]) -> Step:
        frames, rewards, terminated, truncated, _ = self.played.step(actions[ACTION][:, 0])
        return Observed({NAME: frames}, {}), rewards, terminated, truncated

    def close(self) -> None:
        self.played.close()


class Spectator:
    """A policy that records all observations."""

    state_size = 0
    noise_size = NoiseSize(0, 0)
    explores = False

    def __init__(self) -> None:
        self.seen: list[np.ndarray] = []

    def load(self, weights: dict[str, np.ndarray]) -> None:
        pass

    def act(
        self,
        observations: dict[str, np.ndarray],
        state: np.ndarray,
        noise: Noise,
        masks: dict[str, np.ndarray],
        epsilon: np.ndarray | None = None,
    ) -> Choice:
        self.seen.append(observations[NAME].copy())
        rows = len(state)
        return Choice({ACTION: np.zeros((rows, 1), np.int64)}, np.zeros(rows, np.float32), state)


def collected(films: Films, rows: int, count: int) -> tuple[list[Rollout], np.ndarray]:
    """Return rollouts as the learner decodes them, and the observations from which their actions were chosen."""
    spectator = Spectator()
    collector = started_collector(EnvironmentSpec(id="Film-v0"), spectator, rollout_length=rows, environments=films)
    rollouts = []
    for _ in range(count):
        came = decode(encode(collector.collect(IDENTITY)), Limits())
        assert isinstance(came, Rollout)
        rollouts.append(came)
    return rollouts, np.stack(spectator.seen)


def rebuilt(rollout: Rollout, space: ArraySpace) -> np.ndarray:
    """Return the learner's observations [T+1, E, k, *frame_shape], computed into memory that held other values."""
    shape = (rollout.rows + 1, rollout.environments, space.frames, *space.shape)
    out = np.full(shape, 77, space.dtype)
    stack_rows(rollout.frames[NAME], rollout.valid, out)
    return out


episodes = st.lists(st.integers(1, 9), min_size=1, max_size=5)


@settings(max_examples=150, deadline=None, derandomize=True)
@given(
    depth=st.integers(1, 5),
    more_rows=st.integers(0, 6),
    lengths=st.lists(episodes, min_size=1, max_size=3),
    shape=st.sampled_from([(2, 3), (2, 3, 1), (4,)]),
    dtype=st.sampled_from(["uint8", "float32"]),
)
def test_rows_of_rollouts_match_gymnasiums_frame_stack(
    depth: int, more_rows: int, lengths: list[list[int]], shape: tuple[int, ...], dtype: Any
) -> None:
    space = ArraySpace(shape=shape, dtype=dtype, frames=depth)
    rows, count = depth + more_rows, 4
    reference = Films(space, lengths, stacked=True)
    shown = [reference.reset(1).frames[NAME]]
    for _ in range(rows * count):
        shown.append(reference.step({ACTION: np.zeros((reference.count, 1), np.int64)})[0].frames[NAME])
    expected = np.stack(shown)  # [count * T + 1, E, k, *frame_shape]

    rollouts, seen = collected(Films(space, lengths), rows, count)
    np.testing.assert_array_equal(seen, expected[:-1] if depth > 1 else expected[:-1, :, 0])
    for number, rollout in enumerate(rollouts):
        assert rollout.frames[NAME].shape == (depth + rows, len(lengths), *shape)
        first = number * rows
        np.testing.assert_array_equal(rebuilt(rollout, space), expected[first : first + rows + 1])


def test_hand_worked_stacks_of_a_rollout() -> None:
    """Frames 1 to 7 of one environment, a stack of 3, four rows; row 1 only reset, so that an episode starts at row 2.

    Frame 4 is the last of the episode before, frame 5 the first of the new one.
    """
    frames = np.arange(1, 8, dtype=np.float32).reshape(7, 1, 1)
    valid = np.array([[True], [False], [True], [True]])
    out = np.zeros((5, 1, 3, 1), np.float32)
    stack_rows(frames, valid, out)
    assert out[:, 0, :, 0].tolist() == [[1, 2, 3], [2, 3, 4], [5, 5, 5], [5, 5, 6], [5, 6, 7]]


def test_hand_worked_running_stacks() -> None:
    stack = FrameStack(ArraySpace(shape=(1,), dtype="uint8", frames=3), 2)
    seen = []
    for frame, starts in ((1, (True, True)), (2, (False, False)), (3, (False, True)), (4, (False, False))):
        stack.push(np.full((2, 1), frame, np.uint8), np.array(starts))
        seen.append(stack.observations[:, :, 0].tolist())
    assert seen == [[[1, 1, 1]] * 2, [[1, 1, 2]] * 2, [[1, 2, 3], [3, 3, 3]], [[2, 3, 4], [3, 3, 4]]]
    assert stack.observations.dtype == np.uint8


@pytest.mark.parametrize("depth", [1, 4])
def test_stack_of_one_frame_is_the_frame_and_floats_are_float32(depth: int) -> None:
    space = ArraySpace(shape=(2,), dtype="float32", frames=depth)
    stack = FrameStack(space, 1)
    assert stack.frames.shape == (1, depth, 2)
    stack.push(np.array([[0.1, 0.2]]), np.array([True]))
    assert stack.observations.shape == (1, *space.stacked_shape)
    assert stack.observations.dtype == np.float32
    np.testing.assert_array_equal(stack.observations.reshape(depth, 2), np.array([[0.1, 0.2]] * depth, np.float32))


def test_images_are_sent_with_environments_first_and_vectors_with_time_first() -> None:
    for shape, swapped in (((2, 3), True), ((4,), False)):
        rollouts, _ = collected(Films(ArraySpace(shape=shape, dtype="uint8"), [[3], [4]]), rows=5, count=1)
        assert rollouts[0].frames[NAME].swapaxes(0, 1).flags.c_contiguous == swapped
