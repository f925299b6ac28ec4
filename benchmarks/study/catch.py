"""Catch-v0: a quick task with pixels. A ball falls, and a paddle has to be below it when it arrives."""

from typing import Any

import gymnasium
import numpy as np

_SIDE = 20  # pixels; the smallest image of the pixel defaults is 16
_PADDLE = 3  # pixels wide


class Catch(gymnasium.Env[np.ndarray, np.integer]):
    """One ball an episode, from a random column; 19 steps. Actions: left, stay, right. Return: 1 if caught, else -1."""

    def __init__(self) -> None:
        self.observation_space = gymnasium.spaces.Box(0, 255, (_SIDE, _SIDE), np.uint8)
        self.action_space = gymnasium.spaces.Discrete(3)
        self._row = self._column = self._paddle = 0

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[np.ndarray, dict]:
        """Let a new ball fall. See gymnasium.Env."""
        super().reset(seed=seed)
        self._row, self._column = 0, int(self.np_random.integers(_SIDE))
        self._paddle = (_SIDE - _PADDLE) // 2  # its left end
        return self._picture(), {}

    def step(self, action: np.integer) -> tuple[np.ndarray, float, bool, bool, dict]:
        """Move the paddle by one pixel, and let the ball fall by one. See gymnasium.Env."""
        self._paddle = min(max(self._paddle + int(action) - 1, 0), _SIDE - _PADDLE)
        self._row += 1
        arrived = self._row == _SIDE - 1
        caught = self._paddle <= self._column < self._paddle + _PADDLE
        return self._picture(), (1.0 if caught else -1.0) if arrived else 0.0, arrived, False, {}

    def _picture(self) -> np.ndarray:
        picture = np.zeros((_SIDE, _SIDE), np.uint8)
        picture[_SIDE - 1, self._paddle : self._paddle + _PADDLE] = 128
        picture[self._row, self._column] = 255
        return picture


gymnasium.register("Catch-v0", lambda **kwargs: Catch(**kwargs))
