"""An environment that is easy in training. Files in the working directory make its evaluations worse."""

import sys
import time
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
from gymnasium.spaces import Box, Discrete

UNLUCKY = Path("unlucky")  # is removed by the next evaluation, whose episodes all have a return of 0
WAITING = Path("waiting")  # evaluations wait as long as it exists
BUSY = Path("busy")  # is removed by the next evaluation, which cannot create its environments


class Lucky(gymnasium.Env[Any, Any]):
    """Environment whose episodes have two steps and a return of 1, with exceptions in evaluations."""

    observation_space = Box(-1.0, 1.0, (2,), np.float32)
    action_space = Discrete(2)

    def __init__(self, **_arguments: Any) -> None:
        self._evaluated = Path(sys.argv[0]).name == "evaluate.py" or "--evaluator" in sys.argv
        self._unlucky = self._evaluated and UNLUCKY.exists()
        if self._evaluated and BUSY.exists():
            BUSY.unlink()
            raise OSError("all 1 ports are in use")
        self._step = 0

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        super().reset(seed=seed)
        self._step = 0
        return np.zeros(2, np.float32), {}

    def step(self, action: Any) -> Any:
        time.sleep(0.0 if self._evaluated else 0.001)  # training leaves the processor to evaluations
        while self._evaluated and WAITING.exists():
            time.sleep(0.01)
        self._step += 1
        over = self._step == 2
        return np.zeros(2, np.float32), float(over and not self._unlucky), over, False, {}

    def close(self) -> None:
        if self._unlucky:
            UNLUCKY.unlink(missing_ok=True)


gymnasium.register("Lucky-v0", Lucky)
