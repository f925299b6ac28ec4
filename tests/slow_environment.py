"""CartPole with slow steps."""

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


gymnasium.register("Slow-v0", Slow, max_episode_steps=500)
