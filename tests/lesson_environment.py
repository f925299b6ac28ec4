"""Environments with parameters: by options of reset and by a method. A file bounds what the latter takes on a host."""

import os
from typing import Any

import gymnasium
import numpy as np
from gymnasium.spaces import Box, Discrete


class Path(gymnasium.Env[Any, Any]):
    """An episode goes on for `stones` steps while each action is what the observation shows. The end has a reward."""

    observation_space = Box(-1.0, 1.0, (1,), np.float32)
    action_space = Discrete(2)

    def __init__(self, *, always_opens: bool = False) -> None:
        self._always_opens = always_opens  # then each action is right
        self.stones = 30

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        super().reset(seed=seed)
        self.stones = (options or {}).get("stones", self.stones)
        self._sides = self.np_random.integers(2, size=self.stones + 1)
        self._place = 0
        return self._observation(), {}

    def step(self, action: Any) -> Any:
        sinks = bool(action != self._sides[self._place]) and not self._always_opens
        self._place += 1
        arrives = not sinks and self._place == self.stones
        return self._observation(), float(arrives), arrives or sinks, False, {}

    def _observation(self) -> np.ndarray:
        return np.array([2 * self._sides[self._place] - 1], np.float32)


class PathWithMethod(Path):
    """The same with `set_parameters`. The variable MOST_STONES bounds the number that a host takes."""

    def set_parameters(self, *, stones: int) -> None:
        most = int(os.environ.get("MOST_STONES", "100"))
        if stones > most:
            raise ValueError(f"at most {most} stones fit here")
        self.stones = stones

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        assert not options
        return super().reset(seed=seed)


class Wearing(PathWithMethod):
    """A path that loses its stones when an episode ends."""

    def step(self, action: Any) -> Any:
        observation, reward, terminated, *rest = super().step(action)
        self.stones = 1 if terminated else self.stones
        return observation, reward, terminated, *rest


class Odd(gymnasium.Env[Any, Any]):
    """Reads its options in one of many ways."""

    observation_space = Box(-1.0, 1.0, (1,), np.float32)
    action_space = Discrete(2)

    def __init__(self, *, way: str) -> None:
        self._way = way

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        def by_keyword(stones: int = 0) -> int:
            return stones

        stones = {
            "item": lambda: options["stones"],
            "merged": lambda: ({"stones": 1} | options)["stones"],
            "merging": lambda: (options | {"speed": 1})["stones"],
            "keywords": lambda: by_keyword(**options),
            "copied": lambda: dict(options)["stones"],
            "updated": lambda: _updated({}, options)["stones"],
            "nothing": lambda: options.get("stone", 7),
        }[self._way]()
        assert self._way == "nothing" or stones == 7
        return np.zeros(1, np.float32), {}

    def step(self, action: Any) -> Any:
        return np.zeros(1, np.float32), 0.0, True, False, {}


def _updated(known: dict[str, Any], options: Any) -> dict[str, Any]:
    known.update(options)
    return known
