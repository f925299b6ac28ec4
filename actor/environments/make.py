"""EnvironmentSpec -> vectorised environment, behind one small interface.

All step under gymnasium's NEXT_STEP rule: the step after an episode's end ignores its action and resets. They show
single frames; stacks are made of them elsewhere (protocol/frames.py). Rewards are the environment's own.
"""

from collections.abc import Callable
from typing import Protocol

import gymnasium
import numpy as np

from daedalus.actor.environments.action_table import env_actions
from daedalus.actor.environments.environment_errors import EnvironmentSetupError
from daedalus.actor.environments.pixels import Pixels
from daedalus.protocol.spec import ArraySpace, DiscreteSpace, EnvironmentSpec, Spaces

__all__ = ["EnvironmentSetupError", "Transforms", "VectorEnvironment", "make_environments"]

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


class Transforms:
    """A specification's action table and pixel transforms, between an environment's spaces and the run's."""

    def __init__(
        self, spec: EnvironmentSpec, observation_space: gymnasium.Space, action_space: gymnasium.Space
    ) -> None:
        """Raises EnvironmentSetupError if they do not fit."""
        if not isinstance(observation_space, gymnasium.spaces.Box) or not 1 <= len(observation_space.shape) <= 4:
            raise EnvironmentSetupError(
                f"observation space {observation_space} is not supported: it must be a Box of one to four dimensions"
            )
        self._actions = env_actions(spec.action_table, action_space)
        self._pixels = Pixels(spec, observation_space)
        dtype = "uint8" if observation_space.dtype == np.uint8 else "float32"
        self.spaces = Spaces(
            observation=ArraySpace(shape=self._pixels.shape, dtype=dtype, frames=spec.frame_stack),
            action=DiscreteSpace(count=len(self._actions)),
        )

    def frames(self, frames: np.ndarray) -> np.ndarray:
        """[E, *the environment's shape] as the run has them: [E, *frame_shape]."""
        return self._pixels(frames)

    def env_actions(self, choices: np.ndarray) -> np.ndarray:
        """[E] choices as the environment takes them: [E, *action_shape]."""
        return self._actions[choices]


class TransformedEnvironment:
    """A bare environment seen through a specification's transforms."""

    def __init__(self, bare: BackendEnvironments, spec: EnvironmentSpec) -> None:
        """Raises EnvironmentSetupError if the two do not fit."""
        self._bare = bare
        self._transforms = Transforms(spec, bare.observation_space, bare.action_space)

    @property
    def count(self) -> int:
        """See VectorEnvironment."""
        return self._bare.count

    @property
    def spaces(self) -> Spaces:
        """See VectorEnvironment."""
        return self._transforms.spaces

    def reset(self, seed: int) -> np.ndarray:
        """See VectorEnvironment."""
        return self._transforms.frames(self._bare.reset(seed))

    def step(self, actions: np.ndarray) -> Step:
        """See VectorEnvironment."""
        frames, rewards, terminated, truncated = self._bare.step(self._transforms.env_actions(actions))
        return self._transforms.frames(frames), rewards, terminated, truncated

    def close(self) -> None:
        """See VectorEnvironment."""
        self._bare.close()


def make_environments(
    spec: EnvironmentSpec,
    count: int,
    *,
    wrap: str | None = None,
    render_mode: str | None = None,
    camera: Callable[[np.ndarray], None] | None = None,
) -> VectorEnvironment:
    """`count` environments of one kind, by the backend that the specification names.

    Args:
      spec: what to play and what to do to it.
      count: E.
      wrap: `module:function` (gymnasium.Env -> gymnasium.Env), applied to each before the specification's transforms.
      render_mode: gymnasium's; "human" opens a window, "rgb_array" is what a camera needs.
      camera: called with the picture [H, W, 3] uint8 after the reset and after every step of the environment's own,
        the repeated ones too. One environment only.

    The last three are for the gymnasium backend only.

    Raises EnvironmentSetupError with one line that says what is wrong and what to do.
    """
    if spec.backend != "gymnasium":
        _refuse_what_only_gymnasium_does(spec, {"wrap": wrap, "render_mode": render_mode, "camera": camera})
    bare, rest = _make_bare(spec, count, wrap, render_mode, camera)
    try:
        return TransformedEnvironment(bare, rest)
    except EnvironmentSetupError:
        bare.close()
        raise


def _make_bare(
    spec: EnvironmentSpec,
    count: int,
    wrap: str | None,
    render_mode: str | None,
    camera: Callable[[np.ndarray], None] | None,
) -> tuple[BackendEnvironments, EnvironmentSpec]:
    """The backend's environments, and the specification with the transforms that are left to do."""
    match spec.backend:
        case "envpool":
            from daedalus.actor.environments.envpool_backend import (
                make_envpool,  # a backend is imported when it is played
            )

            return make_envpool(spec, count)
        case "ale":
            from daedalus.actor.environments.ale_backend import make_ale

            return make_ale(spec, count)
        case "gymnasium" | "fast":
            from daedalus.actor.environments.gymnasium_backend import make_gymnasium

            return make_gymnasium(spec, count, wrap=wrap, render_mode=render_mode, camera=camera), spec


def _refuse_what_only_gymnasium_does(spec: EnvironmentSpec, asked: dict[str, object]) -> None:
    names = [name for name, value in asked.items() if value is not None]
    if names:
        raise EnvironmentSetupError(
            f"environment.backend={spec.backend} does not do {' and '.join(names)}: "
            "leave it out, or play gymnasium's (--set environment.backend=gymnasium)"
        )
