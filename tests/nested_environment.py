"""Task with nested observations and actions, each part of which is learned from another part of the observation.

Importing this module registers `Nested-v0` and `NestedMasked-v0`, whose info has an `action_mask` for the first part of
the action. Processes started in this folder can play `nested_environment:Nested-v0`.
"""

from typing import Any

import gymnasium
import numpy as np
from gymnasium import spaces as gym

LENGTH = 8  # steps of an episode; the largest return, too
TARGET = 6.4  # a policy that ignores a part of the observation has at most 6.3
SETTINGS = (  # that learn it in seconds
    f"training.target_return={TARGET}",
    "environment.frame_stack=1",
    "policy.encoder=small",
    "policy.initial_std=0.3",
    "training.discount_factor=0.0",
    "training.entropy_bonus=0.0",
    "training.learning_rate=0.002",
    "training.minibatches=8",
)
_SIDE = 20  # pixels of the square image
_PLACES = 4  # vertical stripes of the image: one is bright

Action = tuple[np.int64, np.ndarray, np.ndarray]


class NestedEnvironment(gymnasium.Env):
    """Environment that rewards actions that agree with the observation. The reward of a step is the mean of three:

    - 1 if the first part of the action is the bright stripe of the image;
    - 1 - 2 d, at least 0, if d is the distance of the second part from the level plus 1;
    - 1 if the third part has the two bits of the code.

    A policy that ignores one part of the observation has a mean return of at most 6.3 (with masks it guesses one stripe
    of three), and a random policy about 2.2.
    """

    observation_space = gym.Dict(
        {
            "camera": gym.Dict({"image": gym.Box(0, 255, (_SIDE, _SIDE), np.uint8)}),
            "sensors": gym.Dict({"level": gym.Box(-1.0, 1.0, (1,), np.float32), "code": gym.Discrete(4, start=2)}),
        }
    )
    action_space = gym.Tuple((gym.Discrete(_PLACES), gym.Box(0.0, 2.0, (1,), np.float32), gym.MultiBinary(2)))

    def __init__(self, *, masked: bool = False) -> None:
        self._masked = masked

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[dict, dict]:
        super().reset(seed=seed)
        self._step = 0
        return self._show()

    def step(self, action: Action) -> tuple[dict, float, bool, bool, dict]:
        assert self.action_space.contains(action), f"{action} is outside the action space"
        place, height, bits = action
        if self._masked and place == self._forbidden:
            raise ValueError(f"the action {place} is illegal here")
        right = [
            float(place == self._place),
            max(0.0, 1.0 - 2.0 * abs(float(height[0]) - 1.0 - self._level)),
            float(bits[0] + 2 * bits[1] == self._code),
        ]
        self._step += 1
        observation, info = self._show()
        return observation, sum(right) / 3.0, self._step == LENGTH, False, info

    def _show(self) -> tuple[dict, dict]:
        """Draw what the next action must be, and return the observation and the info."""
        self._place, self._code = int(self.np_random.integers(_PLACES)), int(self.np_random.integers(4))
        self._level = float(self.np_random.uniform(-1.0, 1.0))
        self._forbidden = (self._place + int(self.np_random.integers(1, _PLACES))) % _PLACES
        image = self.np_random.integers(0, 64, (_SIDE, _SIDE), np.uint8)
        image[:, np.arange(_SIDE) * _PLACES // _SIDE == self._place] += 128
        observation = {
            "camera": {"image": image},
            "sensors": {"level": np.array([self._level], np.float32), "code": np.int64(2 + self._code)},
        }
        mask = (np.arange(_PLACES) != self._forbidden).astype(np.int8)
        return observation, {"action_mask": {"0": mask}} if self._masked else {}


gymnasium.register("Nested-v0", "nested_environment:NestedEnvironment")
gymnasium.register("NestedMasked-v0", "nested_environment:NestedEnvironment", kwargs={"masked": True})
