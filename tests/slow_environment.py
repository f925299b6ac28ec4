"""CartPole and Pendulum with slow steps."""

import time
from typing import Any

import gymnasium
from gymnasium.envs.classic_control.cartpole import CartPoleEnv
from gymnasium.envs.classic_control.pendulum import PendulumEnv


class Slow(CartPoleEnv):
    """CartPole whose steps take `seconds`."""

    def __init__(self, seconds: float = 0.004, **arguments: Any) -> None:
        super().__init__(**arguments)
        self._seconds = seconds

    def step(self, action: Any) -> Any:
        time.sleep(self._seconds)
        return super().step(action)


class SlowPendulum(PendulumEnv):
    """Pendulum whose steps take `seconds`, as those of a simulator."""

    def __init__(self, seconds: float = 0.05, **arguments: Any) -> None:
        super().__init__(**arguments)
        self._seconds = seconds

    def step(self, u: Any) -> Any:
        time.sleep(self._seconds)
        return super().step(u)


gymnasium.register("Slow-v0", Slow, max_episode_steps=500)
gymnasium.register("SlowPendulum-v0", SlowPendulum, max_episode_steps=200)
