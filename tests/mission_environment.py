"""Environment with a text in its observation, in a space of its own class, as MiniGrid has missions.

Importing this module registers `Mission-v0`. The text is another in each episode if `missions` has several. With
`text_space` the space of the text is gymnasium's Text, which has no blanks; `disconnects` makes the second step fail.
"""

from typing import Any

import gymnasium
import numpy as np
from gymnasium import spaces as gym


class MissionSpace(gymnasium.Space[str]):
    """Space of all texts."""

    def __init__(self) -> None:
        super().__init__(dtype=str)

    def __eq__(self, other: object) -> bool:  # that of another process is equal
        return isinstance(other, MissionSpace)

    def contains(self, x: Any) -> bool:
        return isinstance(x, str)

    def sample(self, *_arguments: Any, **_options: Any) -> str:
        return "sample"


class Mission(gymnasium.Env):
    """Environment of four steps; the observation is the step, and the mission of the episode."""

    _step_space = gym.Box(0.0, 4.0, (1,), np.float32)
    observation_space = gym.Dict({"mission": MissionSpace(), "step": _step_space})
    action_space = gym.Discrete(2)

    def __init__(
        self, missions: tuple[str, ...] = ("open the door",), text_space: bool = False, disconnects: bool = False
    ) -> None:
        self._missions, self._disconnects = missions, disconnects
        if text_space:
            self.observation_space = gym.Dict({"mission": gym.Text(30), "step": self._step_space})

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[dict, dict]:
        super().reset(seed=seed)
        self._step, self._mission = 0, self._missions[int(self.np_random.integers(len(self._missions)))]
        return self._observe(), {}

    def step(self, action: np.int64) -> tuple[dict, float, bool, bool, dict]:
        self._step += 1
        if self._disconnects and self._step == 2:
            raise ValueError("motor 3 is disconnected")
        return self._observe(), float(action), self._step == 4, False, {}

    def _observe(self) -> dict:
        return {"mission": self._mission, "step": np.array([self._step], np.float32)}


gymnasium.register("Mission-v0", "mission_environment:Mission")
