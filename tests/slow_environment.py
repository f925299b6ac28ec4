"""CartPole and Reacher with slow steps."""

import time
from typing import Any

import gymnasium
from gymnasium.envs.classic_control.cartpole import CartPoleEnv


class Slow(CartPoleEnv):
    """CartPole whose steps take `seconds`."""

    def __init__(self, seconds: float = 0.004, **arguments: Any) -> None:
        super().__init__(**arguments)
        self._seconds = seconds

    def step(self, action: Any) -> Any:
        time.sleep(self._seconds)
        return super().step(action)


class SlowSteps(gymnasium.Wrapper):
    """An environment whose steps take `seconds`, as those of a simulator."""

    def __init__(self, environment: gymnasium.Env, seconds: float) -> None:
        super().__init__(environment)
        self._seconds = seconds

    def step(self, action: Any) -> Any:
        time.sleep(self._seconds)
        return super().step(action)


def slow_reacher(seconds: float = 0.05, **arguments: Any) -> gymnasium.Env:
    """Reacher with slow steps. It needs MuJoCo."""
    return SlowSteps(gymnasium.make("Reacher-v5", **arguments).unwrapped, seconds)


gymnasium.register("Slow-v0", Slow, max_episode_steps=500)
gymnasium.register("SlowReacher-v0", slow_reacher, max_episode_steps=50)
