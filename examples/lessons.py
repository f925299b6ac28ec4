"""Learn what is out of reach without lessons: `python examples/lessons.py`, or `--without` to see that.

A walker finds a goal to its left or to its right, 60 steps away, and has a reward only there. In the 120 steps of an
episode random ones get 60 steps far once in many millions. The lessons begin with goals that are near, and put them
farther away whenever the walker reaches most of them. Evaluations play with 60 steps.
"""

import argparse
from typing import Any

import gymnasium
import numpy as np
from gymnasium.spaces import Box, Discrete

import daedalus

DISTANCE = 60


class Walk(gymnasium.Env):
    """A line with a goal on one side. The walker sees the side, and how much of the way is left."""

    observation_space, action_space = Box(-1.0, 1.0, (2,)), Discrete(2)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        self._distance = (options or {}).get("distance", DISTANCE)
        self._goal = self._distance * int(self.np_random.choice((-1, 1)))
        self._place = self._steps = 0
        return self._observation(), {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        self._place += 1 if action else -1
        self._steps += 1
        arrived = self._place == self._goal
        return self._observation(), float(arrived), arrived, self._steps >= 2 * self._distance, {}

    def _observation(self) -> np.ndarray:
        left = np.clip((self._goal - self._place) / DISTANCE, -1.0, 1.0)
        return np.array([np.sign(self._goal), left], np.float32)


def main() -> None:
    options = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    options.add_argument("--without", action="store_true", help="train without lessons")
    options.add_argument("--seed", type=int, default=1)
    parsed = options.parse_args()
    settings: dict[str, Any] = {"environment.parameters.distance": DISTANCE}
    if not parsed.without:
        settings |= {"lessons.distance.steps": [1, 2, 4, 8, 16, 32], "lessons.distance.above": 0.9}
    result = daedalus.train(env=Walk, seed=parsed.seed, env_steps=100_000, settings=settings)
    print(f"reaches the goal in {result.evaluation_return_mean:.0%} of the episodes")


if __name__ == "__main__":
    main()
