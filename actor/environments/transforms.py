"""The action table and pixel transforms of a specification, applied to a backend's environments."""

from typing import Any

import gymnasium
import numpy as np

from daedalus.actor.environments.action_table import env_actions
from daedalus.actor.environments.environment_errors import EnvironmentSetupError
from daedalus.actor.environments.interface import BackendEnvironments, Step
from daedalus.actor.environments.pixels import Pixels
from daedalus.protocol.spaces import ArraySpace, DiscreteSpace, Spaces
from daedalus.protocol.spec import EnvironmentSpec


class Transforms:
    """The mapping between an environment's spaces and the run's: action table and pixel transforms."""

    def __init__(
        self, spec: EnvironmentSpec, observation_space: gymnasium.Space, action_space: gymnasium.Space
    ) -> None:
        """Raises EnvironmentSetupError if the specification does not fit the spaces."""
        if not isinstance(observation_space, gymnasium.spaces.Box) or not 1 <= len(observation_space.shape) <= 4:
            raise EnvironmentSetupError(
                f"observation space {observation_space} is not supported: it must be a Box with one to four dimensions"
            )
        self._observation_space = observation_space
        self._actions = env_actions(spec.action_table, action_space)
        self._pixels = Pixels(spec, observation_space)
        dtype = "uint8" if observation_space.dtype == np.uint8 else "float32"
        self.spaces = Spaces(
            observation=ArraySpace(shape=self._pixels.shape, dtype=dtype, frames=spec.frame_stack),
            action=DiscreteSpace(count=len(self._actions)),
        )

    def frame(self, observation: Any) -> np.ndarray:
        """Return one observation of the environment as the run has it: [1, *frame_shape].

        Raises ValueError if the observation is not of the environment's space.
        """
        space = self._observation_space
        frame = np.asarray(observation, space.dtype)
        if frame.shape != space.shape:
            raise ValueError(f"the observation has shape {frame.shape}, its space {space.shape}")
        if frame.dtype.kind == "f" and not np.isfinite(frame).all():
            raise ValueError("the observation has a value that is not finite")
        return self.frames(frame[None])

    def frames(self, frames: np.ndarray) -> np.ndarray:
        """Return the environment's frames [E, ...] as the run has them: [E, *frame_shape]."""
        return self._pixels(frames)

    def env_actions(self, indices: np.ndarray) -> np.ndarray:
        """Return the environment's actions [E, *action_shape] for action indices [E]."""
        return self._actions[indices]


class TransformedEnvironment:
    """A VectorEnvironment: a backend's environments with the specification's transforms."""

    def __init__(self, environments: BackendEnvironments, spec: EnvironmentSpec) -> None:
        """Raises EnvironmentSetupError if the specification does not fit the environments."""
        self._environments = environments
        self._transforms = Transforms(spec, environments.observation_space, environments.action_space)

    @property
    def count(self) -> int:
        """See VectorEnvironment."""
        return self._environments.count

    @property
    def spaces(self) -> Spaces:
        """See VectorEnvironment."""
        return self._transforms.spaces

    def reset(self, seed: int) -> np.ndarray:
        """See VectorEnvironment."""
        return self._transforms.frames(self._environments.reset(seed))

    def step(self, actions: np.ndarray) -> Step:
        """See VectorEnvironment."""
        frames, rewards, terminated, truncated = self._environments.step(self._transforms.env_actions(actions))
        return self._transforms.frames(frames), rewards, terminated, truncated

    def take_episode_info(self) -> dict[str, np.ndarray]:
        """See VectorEnvironment."""
        return self._environments.take_episode_info()

    def close(self) -> None:
        """See VectorEnvironment."""
        self._environments.close()
