"""Environments that each break gymnasium's interface in one way."""

import os
import signal
import time
from typing import Any

import gymnasium
import numpy as np
from gymnasium.spaces import Box, Discrete


class Faulty(gymnasium.Env[Any, Any]):
    """Environment whose observation is [0.5, 0.5] and whose episodes have 10 steps, with one fault."""

    observation_space = Box(-1.0, 1.0, (2,), np.float32)
    action_space = Discrete(2)

    def __init__(self, fault: str = "", never_ends: bool = False) -> None:
        self._fault, self._never_ends, self._step = fault, never_ends, 0
        if fault == "constructor":
            raise FileNotFoundError("level.txt")
        if fault == "hang":
            time.sleep(3600)

    def _observe(self) -> Any:
        good = np.full(2, 0.5, np.float32)
        faulty = {
            "shape": np.zeros(3, np.float32),
            "dtype": good.astype(np.complex64),
            "nan": np.array([0.0, np.nan], np.float32),
            "bounds": np.array([0.0, 731.5], np.float32),
            "none": None,
        }
        return faulty.get(self._fault, good)

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        super().reset(seed=seed)
        self._step = 0
        return self._observe() if self._fault == "reset" else (self._observe(), {})

    def step(self, action: Any) -> Any:
        self._step += 1
        over: Any = self._step == 10 and not self._never_ends
        if self._fault == "crash":
            os._exit(7)
        if self._fault == "error":
            return {}["missing"]
        reward: Any = np.nan if self._fault == "reward" and self._step == 3 else 1.0
        result = self._observe(), reward, int(over) if self._fault == "flag" else over, False, {}
        return result[:4] if self._fault == "values" else result

    def close(self) -> None:
        if self._fault == "close" and self._step:  # a signal that it handles does not end it, either
            signal.signal(signal.SIGTERM, signal.SIG_IGN)
            time.sleep(3600)


gymnasium.register("Faulty-v0", lambda **kwargs: Faulty(**kwargs))
