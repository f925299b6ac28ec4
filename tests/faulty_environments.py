"""Environments that each break gymnasium's interface in one way."""

import multiprocessing
import os
import signal
import sys
import threading
import time
from typing import Any

import gymnasium
import numpy as np
from gymnasium.spaces import Box, Discrete, MultiBinary


class Faulty(gymnasium.Env[Any, Any]):
    """Environment that observes 0.5 and the step, and whose episodes have 10 steps, with one fault."""

    observation_space = Box(-1.0, 1.0, (2,), np.float32)
    action_space = Discrete(2)

    def __init__(self, fault: str = "", never_ends: bool = False, value: int = 0) -> None:
        self._fault, self._never_ends, self._step, self._value = fault, never_ends, 0, value
        if fault == "map":  # of numbers, and no fault
            self.observation_space = Box(0, 255, (20, 20), np.uint8)
        if fault.endswith("board"):  # no fault
            self.observation_space = MultiBinary((10, 10, 2))
        if fault == "photo":  # no fault
            self.observation_space = Box(0, 255, (200, 160, 3), np.uint8)
        if fault == "driven board":
            self.action_space = Box(-1.0, 1.0, (1,), np.float32)
        if fault == "three numbers":
            self.observation_space = Box(-1.0, 1.0, (3,), np.float32)
        if fault == "constructor":
            raise FileNotFoundError("level.txt")
        if fault == "hang":
            time.sleep(3600)
        if fault == "child process":  # an environment may have one, and no fault
            self._child = multiprocessing.get_context("fork").Process(target=time.sleep, args=(3600,), daemon=True)
            self._child.start()
        if fault == "thread":
            threading.Thread(target=time.sleep, args=(3600,)).start()

    def __getattribute__(self, name: str) -> Any:
        if name.endswith("_space") and super().__getattribute__("__dict__").get("_fault") == f"no {name}":
            raise AttributeError(f"'Faulty' object has no attribute {name!r}")
        return super().__getattribute__(name)

    def _observe(self) -> Any:
        good = np.array([0.5, self._step % 10 / 10], np.float32)
        faulty = {
            "shape": np.zeros(3, np.float32),
            "dtype": good.astype(np.complex64),
            "nan": np.array([0.0, np.nan], np.float32),
            "bounds": np.array([good[1], 731.5], np.float32),
            "none": None,
            "map": np.full((20, 20), self._value, np.uint8),
            "photo": np.full((200, 160, 3), self._step % 2, np.uint8),
            "three numbers": np.zeros(3, np.float32),
            "board": np.full((10, 10, 2), self._step % 2, np.int8),
            "driven board": np.full((10, 10, 2), self._step % 2, np.int8),
        }
        return faulty.get(self._fault, good)

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        super().reset(seed=seed)
        if self._fault == "second episode" and self._step:
            raise ValueError("map 2 is missing")
        self._step = 0
        return self._observe() if self._fault == "reset" else (self._observe(), {})

    def step(self, action: Any) -> Any:
        self._step += 1
        over: Any = self._step == 10 and not self._never_ends
        if self._fault == "close":  # a signal that it handles does not end it, either
            signal.signal(signal.SIGTERM, signal.SIG_IGN)
        if self._fault == "crash":
            os._exit(7)
        if self._fault == "error":
            return {}["missing"]
        if self._fault == "exit":
            sys.exit(0)
        if self._fault == "error of a class of its own":
            raise _SimulatorError(3, "no contact")
        if self._fault == "error in a function":
            _connect()
        if self._fault == "error in a thread":
            thread = threading.Thread(target=_connect, daemon=True)
            thread.start()
            thread.join()
        reward: Any = np.nan if self._fault == "reward" and self._step == 3 else 1.0
        reward = -1e12 if self._fault == "large reward" else reward
        reward = [1.0] if self._fault == "reward in a list" and self._step == 3 else reward
        info: Any = _odd_info(self._step) if self._fault == "info" else {}
        flag: Any = {"flag": int(over), "flag as text": str(over)}.get(self._fault, over)
        result = self._observe(), reward, flag, False, info
        return result[:4] if self._fault == "values" else result

    def close(self) -> None:
        if self._fault == "child process":
            self._child.kill()  # a fork may have the handlers of its parent
            self._child.join()
        if self._fault in ("close", "close alone") and self._step:
            time.sleep(3600)


class _SimulatorError(Exception):
    """Error that cannot be unpickled: its arguments are not those of its constructor."""

    def __init__(self, code: int, text: str) -> None:
        super().__init__(f"{text} (code {code})")


def _connect() -> None:
    raise ConnectionError("no simulator")


def _odd_info(step: int) -> dict[Any, Any]:
    """Return entries that gymnasium cannot batch or that cannot leave a process, besides `length` and `hash`."""
    odd = {1: 4, "huge": 10**400, "text or number": "a" if step % 2 else 1.0, "shape": np.zeros(step), "f": lambda: 1}
    return {**odd, "nested": {2: 3}, "length": step, "hash": 2**63 + 5}


class _WithFailingStep(gymnasium.Wrapper[Any, Any, Any, Any]):
    def step(self, action: Any) -> Any:
        raise RuntimeError("the wrapper fails")


def with_failing_step(environment: gymnasium.Env[Any, Any]) -> gymnasium.Env[Any, Any]:
    """Return the environment in a wrapper that raises an exception in `step`."""
    return _WithFailingStep(environment)


gymnasium.register("Faulty-v0", lambda **kwargs: Faulty(**kwargs))
