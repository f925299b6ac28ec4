"""What an environment is to those that play it: E environments stepped together under gymnasium's NEXT_STEP rule.

The step after an episode's end ignores its action and resets. Observations are single frames; stacks are made of them
elsewhere (protocol/frames.py). Rewards are the environment's own.
"""

from typing import Protocol

import gymnasium
import numpy as np

from daedalus.protocol.spaces import Spaces

Step = tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]


class VectorEnvironment(Protocol):
    """E environments stepped together. One owner, no threads."""

    @property
    def count(self) -> int:
        """E."""
        ...

    @property
    def spaces(self) -> Spaces:
        """What one of them shows and takes."""
        ...

    def reset(self, seed: int) -> np.ndarray:
        """Starts an episode in each; returns frames [E, *frame_shape]."""
        ...

    def step(self, actions: np.ndarray) -> Step:
        """Takes one action [E] in each, repeated as the specification says.

        Returns: frames [E, *frame_shape], true rewards [E] (summed over the repeats), terminated [E], truncated [E].
        Where the last step ended an episode this one only resets: reward 0 and the first frame.
        """
        ...

    def close(self) -> None:
        """Ends them."""
        ...


class BackendEnvironments(Protocol):
    """What a backend makes: steps, repeats and cuts episodes as the specification says, with its own spaces."""

    @property
    def count(self) -> int:
        """E."""
        ...

    @property
    def observation_space(self) -> gymnasium.Space:
        """What one of them shows."""
        ...

    @property
    def action_space(self) -> gymnasium.Space:
        """What one of them takes."""
        ...

    def reset(self, seed: int) -> np.ndarray:
        """See VectorEnvironment."""
        ...

    def step(self, actions: np.ndarray) -> Step:
        """See VectorEnvironment; actions [E, *action_shape] are the environment's own."""
        ...

    def close(self) -> None:
        """See VectorEnvironment."""
        ...
