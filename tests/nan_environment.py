"""Broken environment: from the eleventh step on, its rewards are nan."""

from typing import Any

import gymnasium
import numpy as np


class Broken(gymnasium.Env):
    observation_space = gymnasium.spaces.Box(-1.0, 1.0, (4,), np.float32)
    action_space = gymnasium.spaces.Discrete(2)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[np.ndarray, dict]:
        super().reset(seed=seed)
        self._steps = 0
        return np.zeros(4, np.float32), {}

    def step(self, action: int) -> tuple[np.ndarray, float, bool, bool, dict]:
        self._steps += 1
        return np.zeros(4, np.float32), float("nan") if self._steps > 10 else 1.0, False, False, {}


gymnasium.register("Broken-v0", entry_point=f"{__name__}:Broken")
