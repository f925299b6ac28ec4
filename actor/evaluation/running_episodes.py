"""Running episodes of E environments as their policy sees them. State, no threads."""

import numpy as np

from daedalus.actor.environments.environment_errors import EnvironmentSetupError
from daedalus.actor.environments.interface import Observed
from daedalus.policy.acting.noise import Noise
from daedalus.policy.acting.program_check import PolicyError
from daedalus.policy.acting.runtime import Choice, PolicyRuntime
from daedalus.protocol.frames import ObservationStacks
from daedalus.protocol.spaces import Spaces, unfit_number

_Components = dict[str, np.ndarray]


class RunningEpisodes:
    """The frame stacks, the newest masks and the memory of a policy that plays one episode in each environment."""

    def __init__(self, spaces: Spaces, runtime: PolicyRuntime, environments: int) -> None:
        """Begin before the first observations of the episodes."""
        self._runtime, self._stacks = runtime, ObservationStacks(spaces, environments)
        self._starts = np.ones(environments, np.bool_)
        self._frames: _Components = {}  # the newest
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
        self._frames, self._masks = observed.frames, observed.masks

    def act(self, noise: Noise, playing: np.ndarray | None = None) -> Choice:
        """Choose the next actions.

        Args:
          noise: for E rows, or for a multiple of E: then all rows are repeated, for more samples of each action.
          playing: [E] bool, which episodes go on: the actions of the others have no effect; None: all.

        Returns: the choices of all rows of the noise. The first E are those of the environments; they alone change the
        memory. Raises EnvironmentSetupError for an observation, of an episode that goes on, which training refuses.
        """
        count = len(self._state)
        playing = np.ones(count, np.bool_) if playing is None else playing
        self._refuse_unfit(playing)
        repeats = len(noise.uniform) // count
        choice = self._runtime.act(
            {name: _repeated(values, repeats) for name, values in self.observations.items()},
            _repeated(self._state, repeats),
            noise,
            {name: _repeated(values, repeats) for name, values in self._masks.items()},
        )
        for name, values in choice.actions.items():
            if not np.isfinite(values[:count][playing]).all():
                raise PolicyError(f"the policy chose an action whose component {name!r} is not finite: do not use it")
        self._state = choice.state[:count]
        return choice

    def _refuse_unfit(self, playing: np.ndarray) -> None:
        for name, frames in self._frames.items():
            if not unfit_number(frames):
                continue
            for row in np.flatnonzero(playing):
                if unfit := unfit_number(frames[row]):
                    raise EnvironmentSetupError(
                        f"the environment returned an observation whose component {name!r} {unfit}, in environment "
                        f"{row}: the policy cannot act on it, and training refuses it; correct `reset` or `step`"
                    )


def refuse_unfit_rewards(rewards: np.ndarray, numbers: np.ndarray) -> None:
    """Raise EnvironmentSetupError if a reward [n] of the episodes `numbers` [n] is not finite: they have no return."""
    faulty = ~(np.abs(rewards) <= np.finfo(np.float32).max)  # of float32, as training has them
    if faulty.any():
        raise EnvironmentSetupError(
            f"the environment gave the reward {rewards[faulty][0]} in episode {numbers[faulty][0] + 1} of the "
            "evaluation: rewards must be finite in float32; correct its `step`"
        )


def _repeated(rows: np.ndarray, repeats: int) -> np.ndarray:
    return rows if repeats == 1 else np.concatenate([rows] * repeats)
