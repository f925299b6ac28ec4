"""Wrapper with rare nan rewards: one rollout in a hundred of the CartPole preset contains one."""

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
    """Wrap an environment, for `daedalus train cartpole --wrap poison:poisoned`."""
    return _Poisoned(env)
