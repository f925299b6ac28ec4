"""The interfaces of environments: E environments stepped together under gymnasium's NEXT_STEP rule.

The step after an episode's end ignores its action and resets. Observations are single frames; protocol/frames.py
stacks them. Rewards are the environment's own.
"""

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, NamedTuple, Protocol

import gymnasium
import numpy as np

from daedalus.protocol.lessons import Parameters
from daedalus.protocol.spaces import Spaces

if TYPE_CHECKING:
    from daedalus.actor.environments.games import GameEnvironments


class Observed(NamedTuple):
    """What E environments show: one frame of each component, and which actions are legal."""

    frames: dict[str, np.ndarray]  # of each component [E, *frame_shape]
    masks: dict[str, np.ndarray]  # of the masked actions [E, choices] bool
    acting: np.ndarray | None = None  # [E] bool, the seats of games that have something new; None: all environments
    over: np.ndarray | None = None  # of each game, bool: whether its match has ended; None: there are no games


Step = tuple[Observed, np.ndarray, np.ndarray, np.ndarray]
BackendStep = tuple[Any, np.ndarray, np.ndarray, np.ndarray]


class VectorEnvironment(Protocol):
    """E environments stepped together. One owner, no threads."""

    @property
    def count(self) -> int:
        """E, the number of environments."""
        ...

    @property
    def spaces(self) -> Spaces:
        """The observation and action space of one environment, as the run has them."""
        ...

    @property
    def games(self) -> "GameEnvironments | None":
        """The games whose seats these environments are; None for environments with one agent."""
        ...

    @property
    def seats(self) -> int:
        """Seats of each game, which are side by side; 1 for environments with one agent."""
        ...

    def reset(self, seed: int) -> Observed:
        """Start an episode in each environment, with seed + e in environment e.

        The environments of some backends share one random generator, with the seed `seed`, unless they are made for
        evaluation (see make_environments).
        """
        ...

    def step(self, actions: dict[str, np.ndarray]) -> Step:
        """Take one action in each environment, repeated as the specification says.

        Args:
          actions: of each component [E, D].

        Returns: the next observations, true rewards [E] (summed over the repeats), terminated [E], truncated [E].
        In an environment whose last step ended an episode, this step only resets: reward 0 and the first frame. An
        episode that no_reward_limit ends is both terminated and truncated, and no other where that limit is set.
        Raises EnvironmentSetupError for a mask that forbids every action.
        """
        ...

    def set_parameters(self, parameters: Mapping[int, Parameters]) -> None:
        """Set what some of the environments, by their index, begin their next episodes with, in place of the true task.

        The specification has `parameters`, with the same names.
        """
        ...

    def take_episode_info(self) -> dict[str, np.ndarray]:
        """Return scalars of `info` at the ends of the episodes since the last call: name -> [n] float64.

        Empty if the environment reports none, or the backend does not pass them on.
        """
        ...

    def close(self) -> None:
        """Close the environments. Idempotent."""
        ...


class BackendEnvironments(Protocol):
    """A backend's environments, with their own spaces: they repeat actions and truncate episodes as specified.

    Those of games are seats, E over all copies. A step reaches only the seats that are `acting`: those that had
    something new after the last one. The reward of a seat is the sum since its last action; one that comes before its
    first action of a match counts in the result of the match only.
    """

    @property
    def count(self) -> int:
        """E, the number of environments."""
        ...

    @property
    def observation_space(self) -> gymnasium.Space:
        """The observation space of one environment."""
        ...

    @property
    def action_space(self) -> gymnasium.Space:
        """The action space of one environment."""
        ...

    @property
    def action_mask(self) -> Any:
        """The legal actions of the newest observations, batched as gymnasium's `info` is; None without masks.

        Known from construction on: an environment either has masks or has none.
        """
        ...

    def reset(self, seed: int) -> Any:
        """Start an episode in each environment, and return batched observations of the environment's own space."""
        ...

    def step(self, actions: Any) -> BackendStep:
        """See VectorEnvironment; observations and actions are the environment's own, batched by component."""
        ...

    def take_episode_info(self) -> dict[str, np.ndarray]:
        """See VectorEnvironment."""
        ...

    def close(self) -> None:
        """See VectorEnvironment."""
        ...
