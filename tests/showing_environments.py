"""Environments that show given numbers: those that float32, a dtype or a learner does not take."""

import io
import signal
import sys
import warnings
from typing import Any

import gymnasium
import numpy as np
from gymnasium.spaces import Box, Discrete


class Showing(gymnasium.Env[Any, Any]):
    """Environment that shows given numbers, one a step, and ends its episode with the last one.

    Its observation space has the dtype `space`, the observations have `dtype`. Rewards are 1, or those given.
    """

    action_space = Discrete(2)
    render_mode = "rgb_array"

    def __init__(
        self,
        shown: list[Any],
        space: str = "float32",
        dtype: str = "",
        rewards: list[Any] | None = None,
        **_options: Any,
    ) -> None:
        self.observation_space = _box(space)
        self._shown = [np.array([float(number) if isinstance(number, str) else number]) for number in shown]
        self._shown = [number.astype(dtype or space) for number in self._shown]
        self._rewards = [float(reward) for reward in rewards or [1.0] * len(shown)]
        self.actions: list[Any] = []

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        super().reset(seed=seed)
        self._step = 0
        return self._shown[0], {}

    def step(self, action: Any) -> Any:
        self._step += 1
        self.actions.append(action)
        over = self._step == len(self._shown) - 1
        return self._shown[self._step], self._rewards[self._step], over, False, {}

    def render(self) -> Any:
        return np.zeros((16, 16, 3), np.uint8)


def _box(dtype: str) -> Box:
    if dtype.startswith("float"):
        return Box(-np.inf, np.inf, (1,), np.dtype(dtype).type)
    limits = np.iinfo(dtype)
    return Box(limits.min, limits.max, (1,), np.dtype(dtype).type)


class Strict(Showing):
    """Showing, which sets interpreter-wide state when it is made."""

    def __init__(self, **options: Any) -> None:
        super().__init__(**options)
        np.seterr(all="raise")
        warnings.simplefilter("error")
        sys.stdout = io.StringIO()
        signal.signal(signal.SIGTERM, signal.SIG_IGN)

    def step(self, action: Any) -> Any:
        assert np.geterr()["over"] == "raise"  # it has what it set
        return super().step(action)


gymnasium.register("Strict-v0", Strict)


class ShowingVector(gymnasium.vector.VectorEnv[Any, Any, Any]):
    """The same for several at once. A step that only resets has the reward 50, or the flags, where it is asked to."""

    metadata = {"autoreset_mode": gymnasium.vector.AutoresetMode.NEXT_STEP}  # noqa: RUF012  # as gymnasium has it

    def __init__(self, num_envs: int, shown: list[Any], oddity: str = "", **options: Any) -> None:
        self._environments = [Showing(shown, **options) for _ in range(num_envs)]
        self.num_envs, self._oddity, self._over = num_envs, oddity, False
        self.single_observation_space = self._environments[0].observation_space
        self.single_action_space = Showing.action_space

    def reset(self, *, seed: Any = None, options: Any = None) -> Any:
        self._over = False
        return np.stack([each.reset(seed=seed)[0] for each in self._environments]), {}

    def step(self, actions: Any) -> Any:
        ones = np.ones(self.num_envs)
        if self._over:
            flags = ones > 0.0 if self._oddity == "flags" else ones < 0.0
            return self.reset()[0], ones * (50.0 if self._oddity == "rewards" else 0.0), flags, ones < 0.0, {}
        steps = [each.step(action) for each, action in zip(self._environments, actions, strict=True)]
        observations, rewards, terminated, truncated, _ = zip(*steps, strict=True)
        self._over = terminated[0]
        return np.stack(observations), np.array(rewards), np.array(terminated), np.array(truncated), {}


gymnasium.register("Showing-v0", Showing)
gymnasium.register("ShowingVector-v0", vector_entry_point=lambda **kwargs: ShowingVector(**kwargs))
