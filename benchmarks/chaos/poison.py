"""A simulator that is wrong now and then: one rollout in a hundred of CartPole's preset has a reward of nan in it."""

import random
from typing import Any

import gymnasium

_ROLLOUT_STEPS = 128 * 32  # environments x rows
_SHARE = 0.01


class _Poisoned(gymnasium.Wrapper):
    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict]:
        observation, reward, terminated, truncated, info = self.env.step(action)
        if random.random() < _SHARE / _ROLLOUT_STEPS:
            reward = float("nan")
        return observation, reward, terminated, truncated, info


def poisoned(env: gymnasium.Env) -> gymnasium.Env:
    """For `daedalus train cartpole --wrap poison:poisoned`."""
    return _Poisoned(env)
