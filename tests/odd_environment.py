"""Environments that keep to gymnasium's interface in ways that few do, also by a vector entry point of their own."""

from typing import Any

import gymnasium
import numpy as np
from gymnasium.spaces import Box, Dict, Discrete, MultiDiscrete, Sequence
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space


class Odd(gymnasium.Env[Any, Any]):
    """Environment whose episodes have 3 steps, and a reward of 1 each."""

    observation_space = Box(-1.0, 1.0, (2,), np.float32)
    action_space = Discrete(2)

    def __init__(self, close_fails: bool = False, extra: bool = False, masks: str = "", **_arguments: Any) -> None:
        self._close_fails, self._step = close_fails, 0
        self._extra = extra  # a component that a policy cannot read
        if extra:
            self.observation_space = Dict({"seen": Odd.observation_space, "notes": Sequence(Discrete(3))})
        if masks:
            self.action_space = Dict({"arm": Discrete(2), "legs": MultiDiscrete([2, 3])})
            arm, hip, knee = [True, False], [False, True], [True, True, False]
            given = {"lists": [arm, hip, knee], "map": {"arm": arm, "legs": hip + knee}}[masks]
            self.action_masks = lambda: given

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        super().reset(seed=seed)
        if seed is not None:
            np.int32(seed)  # as an extension in C takes it
        self._step = 0
        return self._observe(), {}

    def step(self, action: Any) -> Any:
        self._step += 1
        return self._observe(), 1.0, self._step == 3, False, {}

    def _observe(self) -> Any:
        seen = np.full(2, self._step / 3, np.float32)
        return {"seen": seen, "notes": (0, 2)} if self._extra else seen

    def close(self) -> None:
        if self._close_fails:
            raise ConnectionError("already disconnected")


class Drawn(Odd):
    """Odd, whose rewards are drawn by its constructor, or in `reset`."""

    def __init__(self, drawn_by: str) -> None:
        super().__init__()
        self._drawn_by, self._reward = drawn_by, np.random.default_rng().random()

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        result = super().reset(seed=seed)
        if self._drawn_by == "seed":
            self._reward = self.np_random.random()
        elif self._drawn_by == "reset":
            self._reward = np.random.default_rng().random()
        return result

    def step(self, action: Any) -> Any:
        observation, _, *rest = super().step(action)
        return observation, self._reward, *rest


class Starting(Odd):
    """Odd, whose first observation has a number that is drawn; `seeds` is the generator of a reset without a seed."""

    def __init__(self, seeds: str) -> None:
        super().__init__()
        self._seeds, self._start = seeds, 0.0

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        super().reset(seed=seed)
        if self._seeds == "its own":
            self._start = self.np_random.uniform(-1.0, 1.0)
        else:
            always = self._seeds == "always 42"
            self._start = np.random.default_rng(42 if always or seed is None else seed).uniform(-1.0, 1.0)
        return self._observe(), {}

    def _observe(self) -> Any:
        return np.array([self._start, self._step / 3], np.float32)


class Popping(Odd):
    """Odd, whose constructor takes its options out of a map."""

    def __init__(self, options: dict[str, Any]) -> None:
        super().__init__(masks=options.pop("masks"))


class Vector(VectorEnv[Any, Any, Any]):
    """The same as Odd, for several at once, with one fault or oddity."""

    metadata = {"autoreset_mode": AutoresetMode.NEXT_STEP}  # noqa: RUF012  # as gymnasium has it

    def __init__(self, num_envs: int, oddity: str = "", max_episode_steps: int | None = None) -> None:
        self.num_envs, self._oddity = num_envs, oddity
        if oddity == "constructor":
            raise TypeError("unexpected argument")
        if oddity == "autoreset":
            self.metadata = {"autoreset_mode": AutoresetMode.SAME_STEP}
        self._size = 3 if oddity == "space" else 2
        self.single_observation_space = Box(-1.0, 1.0, (self._size,), np.float32)
        self.single_action_space = Odd.action_space
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self._steps = np.zeros(num_envs, np.int64)

    def reset(self, *, seed: Any = None, options: Any = None) -> Any:
        self._steps[:] = 0
        return self._observe(), {}

    def step(self, actions: Any) -> Any:
        self._steps = np.where((self._steps == 3) & (self._oddity != "endless"), 0, self._steps + 1)
        kind = {"int flags": np.int64, "float flags": np.float32}.get(self._oddity, np.bool_)
        if self._oddity == "step":
            raise ValueError("no such vector")
        ended = (self._steps == 3) & (self._oddity != "endless")
        info = {"score": self._steps * 10 + np.arange(self.num_envs), "_score": ended.astype(kind)}
        rewards = (self._steps > 0) * 1.0
        odd: dict[str, Any] = {"reward column": rewards[:, None], "one reward": 1.0, "text": "ten"}
        rewards = odd.get(self._oddity, rewards)
        info = None if self._oddity == "no info" else info
        return self._observe(), rewards, ended.astype(kind), np.zeros(self.num_envs, kind), info

    def _observe(self) -> Any:
        if self._oddity in ("complex", "fewer rows", "nan"):
            odd = {"complex": np.full((self.num_envs, 2), 0.7 + 0.7j), "fewer rows": np.zeros((1, 2), np.float32)}
            return odd.get(self._oddity, np.full((self.num_envs, 2), np.nan, np.float32))
        return np.repeat(self._steps[:, None] / 3, self._size, axis=1).astype(np.float32)


gymnasium.register("Odd-v0", Odd)
gymnasium.register(
    "OddVector-v0", lambda **_: Odd(), vector_entry_point=lambda **kwargs: Vector(**kwargs), max_episode_steps=20
)
