"""Small memory task: a cue at the start of an episode decides which action is rewarded at its end.

Importing this module registers `Cue-v0`. Processes started in this folder can play `cue_environment:Cue-v0`.
"""

from typing import Any

import gymnasium
import numpy as np

LENGTH = 6  # steps from the cue to the rewarded action, both included


class CueEnvironment(gymnasium.Env):
    """Environment that shows [cue, 0], then [0, 0], last [0, 1]. The last action earns 1 if it is the cue, else -1."""

    observation_space = gymnasium.spaces.Box(-1.0, 1.0, (2,), np.float32)
    action_space = gymnasium.spaces.Discrete(2)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[np.ndarray, dict]:
        super().reset(seed=seed)
        self._cue, self._step = int(self.np_random.integers(2)), 0
        return np.array([2.0 * self._cue - 1.0, 0.0], np.float32), {}

    def step(self, action: int) -> tuple[np.ndarray, float, bool, bool, dict]:
        self._step += 1
        ended = self._step == LENGTH
        reward = (1.0 if action == self._cue else -1.0) if ended else 0.0
        return np.array([0.0, float(self._step >= LENGTH - 1)], np.float32), reward, ended, False, {}


gymnasium.register("Cue-v0", "cue_environment:CueEnvironment")
