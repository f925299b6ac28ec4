"""Environments of a gymnasium vector environment, as the actor steps them."""

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import gymnasium
import numpy as np
from gymnasium.vector import SyncVectorEnv

from daedalus.actor.checking.violations import observation_violations
from daedalus.actor.environments.environment_errors import EnvironmentSetupError
from daedalus.actor.environments.episode_info import EpisodeInfo
from daedalus.actor.environments.interface import BackendStep
from daedalus.actor.environments.masks import MASK_KEY, mask_of_one


class GymnasiumEnvironments:
    """A BackendEnvironments over a gymnasium vector environment."""

    def __init__(self, environment: Any) -> None:
        """Construct from the vector environment, and reset it if its actions may have masks: only `info` shows them.

        Of environments that are stepped in turn only the first is reset: a reset may be slow.
        """
        self._environment = environment
        self.count: int = environment.num_envs
        self.observation_space: gymnasium.Space = environment.single_observation_space
        self.action_space: gymnasium.Space = environment.single_action_space
        self._episode_info = EpisodeInfo()
        self.action_mask: Any = None
        if isinstance(self.action_space, gymnasium.spaces.Box):
            return
        if isinstance(environment, SyncVectorEnv):
            mask = environment.envs[0].reset(seed=0)[1].get(MASK_KEY)
            self.action_mask = None if mask is None else mask_of_one(mask)
        else:
            self.reset(0)

    def reset(self, seed: int) -> Any:
        """See BackendEnvironments."""
        with self._misfits():
            observations, info = self._environment.reset(seed=seed)
        self.action_mask = info.get(MASK_KEY)
        return observations

    def step(self, actions: Any) -> BackendStep:
        """See BackendEnvironments."""
        with self._misfits():
            observations, rewards, terminated, truncated, info = self._environment.step(actions)
        self.action_mask = info.get(MASK_KEY)
        if info:
            self._episode_info.add(info, terminated | truncated)
        return observations, rewards, terminated, truncated

    @contextmanager
    def _misfits(self) -> Iterator[None]:
        """Name an observation that is not of its space: gymnasium only fails to copy it into the batch."""
        try:
            yield
        except (KeyError, IndexError, TypeError, ValueError) as error:
            for observation in getattr(self._environment, "_env_obs", ()):  # of SyncVectorEnv
                if observation is None:
                    continue
                for kind, text in observation_violations(self.observation_space, observation, "a step or a reset"):
                    if kind == "problem":
                        raise EnvironmentSetupError(f"environment: {text}") from error
            raise

    def take_episode_info(self) -> dict[str, np.ndarray]:
        """See BackendEnvironments."""
        return self._episode_info.take()

    def close(self) -> None:
        """See BackendEnvironments."""
        self._environment.close()
