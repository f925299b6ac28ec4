"""Atari games on gymnasium with the frames and the starts that they have on the backends `ale` and `envpool`."""

from typing import Any, SupportsFloat

import gymnasium
import numpy as np

from daedalus.protocol.spec import EnvironmentSpec

# Of the other backends, by the names that they have there: arguments that ALE's environment of gymnasium lacks.
DEFAULTS: dict[str, Any] = {"noop_max": 30, "use_fire_reset": True, "maxpool": True}


class PooledFrames(gymnasium.Wrapper):
    """A wrapper whose observation is the elementwise maximum of the two newest frames (Mnih et al. 2015, methods).

    Many games draw an object in every other frame only.
    """

    _frame: Any = None

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """See gymnasium.Env."""
        self._frame, info = self.env.reset(seed=seed, options=options)
        return self._frame, info

    def step(self, action: Any) -> tuple[Any, SupportsFloat, bool, bool, dict[str, Any]]:
        """See gymnasium.Env."""
        before = self._frame
        self._frame, reward, terminated, truncated, info = self.env.step(action)
        return np.maximum(before, self._frame), reward, terminated, truncated, info


class RandomStart(gymnasium.Wrapper):
    """A wrapper whose episodes begin after a random number of frames without an action (Mnih et al. 2015, methods).

    Without it, a game that does not repeat actions at random begins in the same way for every seed.
    """

    def __init__(self, environment: gymnasium.Env, noop_max: int, use_fire_reset: bool) -> None:
        """Construct from the most frames before an episode, and whether the last of them fires, if the game can."""
        super().__init__(environment)
        self._most = noop_max
        meanings = environment.get_wrapper_attr("get_action_meanings")()
        self._fires = use_fire_reset and "FIRE" in meanings[1:2]

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """See gymnasium.Env."""
        observation, info = self.env.reset(seed=seed, options=options)
        frames = int(self.np_random.integers(1, self._most, endpoint=True)) if self._most > 0 else int(self._fires)
        for left in reversed(range(frames)):
            action = 1 if self._fires and left == 0 else 0
            # The game itself, since these frames do not count against a limit of steps.
            observation, _, terminated, truncated, info = self.unwrapped.step(action)
            if terminated or truncated:
                observation, info = self.env.reset()
        return observation, info


def take_arguments(kwargs: dict[str, Any]) -> dict[str, Any]:
    """Remove the arguments of `wrapped` from those of a game's constructor, and return them."""
    return {name: kwargs.pop(name) for name in DEFAULTS if name in kwargs}


def wrapped(environment: gymnasium.Env, arguments: dict[str, Any]) -> gymnasium.Env:
    """Return a game of ALE with the wrappers that `arguments`, some of DEFAULTS, ask for."""
    most, fires = arguments.get("noop_max", 0), arguments.get("use_fire_reset", False)
    if (most or fires) and isinstance(environment.action_space, gymnasium.spaces.Discrete):
        environment = RandomStart(environment, most, fires)
    return PooledFrames(environment) if arguments.get("maxpool") else environment


def pools_frames(spec: EnvironmentSpec) -> bool:
    """Return whether an observation is the maximum of two frames, in a specification for gymnasium."""
    return spec.kwargs.get("maxpool") is True
