"""Waiting-v0: an environment whose steps take time, as those of a robot or of a slow simulator do."""

import time
from typing import Any

import gymnasium

import benchmarks.study.catch  # noqa: F401 - registers Catch-v0


class Waiting(gymnasium.Wrapper):
    """Wrapper of an environment that makes each step take a given time. Most of the time is spent waiting.

    Args:
        of: id of the other environment.
        milliseconds: duration of a step.
        kwargs: of the other environment.
    """

    def __init__(self, of: str, milliseconds: float, **kwargs: Any) -> None:
        super().__init__(gymnasium.make(of, **kwargs))
        self._seconds = milliseconds / 1000

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        """Take a step of the other environment. See gymnasium.Env."""
        end = time.monotonic() + self._seconds
        result = self.env.step(action)
        time.sleep(max(end - time.monotonic(), 0.0))
        return result


gymnasium.register("Waiting-v0", lambda of, milliseconds, **kwargs: Waiting(of, milliseconds, **kwargs))
