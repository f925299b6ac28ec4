"""Counting environment with pixels and continuous actions, and functions that wrap environments."""

from typing import Any

import gymnasium
import numpy as np


class Picture(gymnasium.Env[np.ndarray, np.ndarray]):
    """Environment whose observation is noise with [episode, step, 0] in the first pixel. Reward: sum of the action."""

    metadata = {"render_modes": ["rgb_array"]}  # noqa: RUF012 - the form that gymnasium uses

    def __init__(self, end: int = 5, render_mode: str | None = None) -> None:
        self.observation_space = gymnasium.spaces.Box(0, 255, (6, 8, 3), np.uint8)
        self.action_space = gymnasium.spaces.Box(
            np.array([-1.0, 0.0], np.float32), np.array([1.0, 0.5], np.float32), dtype=np.float32
        )
        self.render_mode = render_mode
        self._end = end
        self._episode = -1
        self._step = 0

    def _observe(self) -> np.ndarray:
        picture = self.np_random.integers(0, 256, (6, 8, 3), np.uint8)
        picture[0, 0] = self._episode, self._step, 0
        return picture

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[np.ndarray, dict]:
        super().reset(seed=seed)
        self._episode += 1
        self._step = 0
        return self._observe(), {}

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict]:
        assert self.action_space.contains(action)
        self._step += 1
        return self._observe(), float(action.sum()), self._step == self._end, False, {}

    def render(self) -> np.ndarray:
        return np.full((2, 2, 3), self._step, np.uint8)


gymnasium.register("Picture-v0", lambda **kwargs: Picture(**kwargs))


def with_doubled_rewards(environment: gymnasium.Env) -> gymnasium.Env:
    return gymnasium.wrappers.TransformReward(environment, lambda reward: 2 * float(reward))


def with_nothing_to_play(environment: gymnasium.Env) -> str:
    return str(environment)


class _Skipped(gymnasium.Wrapper):
    def step(self, action: Any) -> Any:
        for _ in range(3):
            self.env.step(action)
        return self.env.step(action)


def with_skipped_frames(environment: gymnasium.Env) -> gymnasium.Env:
    return _Skipped(environment)


def with_skipped_frames_that_it_states(environment: gymnasium.Env) -> gymnasium.Env:
    return with_a_rate_of_its_own(_Skipped(environment), 10)


def with_a_rate_of_its_own(environment: gymnasium.Env, rate: float = 7) -> gymnasium.Env:
    environment = gymnasium.Wrapper(environment)
    environment.metadata = {**environment.metadata, "render_fps": rate}
    return environment


def without_rate(environment: gymnasium.Env) -> gymnasium.Env:
    environment = gymnasium.Wrapper(environment)
    environment.metadata = {}
    return environment
