"""Learn what is out of reach without lessons: `python examples/lessons.py`, or `--without` to see that.

On a path of 30 stones each has one of eight marks, and each mark means one of four steps. A wrong step ends the
episode, and only the end of the path has a reward: random steps reach it once in 10^18 episodes. The lessons begin with
paths of one stone, and go to longer ones whenever most episodes reach the end. Evaluations play the whole path.
"""

import argparse
from typing import Any

import gymnasium
import numpy as np
from gymnasium.spaces import Box, Discrete

import daedalus

STONES, MARKS, STEPS = 30, 8, 4


class Path(gymnasium.Env):
    """A path of stones, new in each episode. The walker sees the mark of its stone; its meaning never changes."""

    observation_space, action_space = Box(0.0, 1.0, (MARKS,)), Discrete(STEPS)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Begin a path of `options["stones"]` stones."""
        super().reset(seed=seed)
        stones = (options or {}).get("stones", STONES)
        self._marks = self.np_random.integers(MARKS, size=stones + 1)
        self._place = 0
        return self._observation(), {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """Go on if the step is that of the mark: its number, modulo the number of steps."""
        sinks = bool(action != self._marks[self._place] % STEPS)
        self._place += 1
        arrives = not sinks and self._place == len(self._marks) - 1
        return self._observation(), float(arrives), arrives or sinks, False, {}

    def _observation(self) -> np.ndarray:
        return np.eye(MARKS, dtype=np.float32)[self._marks[self._place]]


def main() -> None:
    options = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    options.add_argument("--without", action="store_true", help="train without lessons")
    options.add_argument("--seed", type=int, default=1)
    parsed = options.parse_args()
    settings: dict[str, Any] = {"environment.parameters.stones": STONES}
    if not parsed.without:
        settings |= {"lessons.stones.steps": [1, 2, 4, 8, 16], "lessons.stones.above": 0.8}
    result = daedalus.train(env=Path, seed=parsed.seed, env_steps=60_000, settings=settings)
    print(f"reaches the end in {result.evaluation_return_mean:.0%} of the episodes")


if __name__ == "__main__":
    main()
