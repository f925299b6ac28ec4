"""Running episodes of E environments as their policy sees them. State, no threads."""

import numpy as np

from daedalus.actor.environments.interface import Observed
from daedalus.policy.acting.noise import Noise
from daedalus.policy.acting.runtime import Choice, PolicyRuntime
from daedalus.protocol.frames import ObservationStacks
from daedalus.protocol.spaces import Spaces

_Components = dict[str, np.ndarray]


class RunningEpisodes:
    """The frame stacks, the newest masks and the memory of a policy that plays one episode in each environment."""

    def __init__(self, spaces: Spaces, runtime: PolicyRuntime, environments: int) -> None:
        """Begin before the first observations of the episodes."""
        self._runtime, self._stacks = runtime, ObservationStacks(spaces, environments)
        self._starts = np.ones(environments, np.bool_)
        self._masks: _Components = {}
        self._state = np.zeros((environments, runtime.state_size), np.float32)

    @property
    def observations(self) -> _Components:
        """The newest observations of the policy, each [E, *stacked_shape]; views, valid until the next `observe`."""
        return self._stacks.observations

    @property
    def state(self) -> np.ndarray:
        """The memory of the policy [E, S] before it chooses the next actions."""
        return self._state

    def observe(self, observed: Observed) -> None:
        """Take what the environments show after a reset or a step."""
        self._stacks.push(observed.frames, self._starts)
        self._starts[:] = False
        self._masks = observed.masks

    def act(self, noise: Noise) -> Choice:
        """Choose the next actions.

        Args:
          noise: for E rows, or for a multiple of E: then all rows are repeated, for more samples of each action.

        Returns: the choices of all rows of the noise. The first E are those of the environments; they alone change the
        memory.
        """
        count = len(self._state)
        repeats = len(noise.uniform) // count
        choice = self._runtime.act(
            {name: _repeated(values, repeats) for name, values in self.observations.items()},
            _repeated(self._state, repeats),
            noise,
            {name: _repeated(values, repeats) for name, values in self._masks.items()},
        )
        self._state = choice.state[:count]
        return choice


def _repeated(rows: np.ndarray, repeats: int) -> np.ndarray:
    return rows if repeats == 1 else np.concatenate([rows] * repeats)
