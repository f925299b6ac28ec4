"""Environment whose observations and rewards count steps, so that a misplaced row is visible."""

from typing import Any

import gymnasium
import numpy as np


class Counting(gymnasium.Env[np.ndarray, np.int64]):
    """Environment that counts. Observation: [episode, step]. Reward: 10 * episode + step + action / 10.

    `ends` lists the lengths of the episodes in turn. A positive number terminates the episode after this number of
    steps; a negative number truncates it. An episode without any step does not count.
    """

    def __init__(self, ends: tuple[int, ...] = (3, -2, 1)) -> None:
        self.observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (2,), np.float32)
        self.action_space = gymnasium.spaces.Discrete(4)
        self._ends = ends
        self._episode = self._step = 0

    def _observe(self) -> np.ndarray:
        return np.array([self._episode, self._step], np.float32)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[np.ndarray, dict]:
        super().reset(seed=seed)
        self._episode += self._step > 0
        self._step = 0
        return self._observe(), {}

    def step(self, action: np.int64) -> tuple[np.ndarray, float, bool, bool, dict]:
        end = self._ends[self._episode % len(self._ends)]
        reward = 10.0 * self._episode + self._step + float(action) / 10.0
        self._step += 1
        over = self._step == abs(end)
        return self._observe(), reward, over and end > 0, over and end < 0, {}


gymnasium.register("Counting-v0", lambda **kwargs: Counting(**kwargs))
