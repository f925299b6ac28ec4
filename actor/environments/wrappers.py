"""Wrappers of one gymnasium environment: masks in `info`, repeated actions, one episode for each seed."""

import copy
from collections.abc import Callable, Sequence
from typing import Any, SupportsFloat

import gymnasium
import numpy as np
from gymnasium import spaces as gym

from daedalus.actor.checking.violations import flag_violations, observation_violations, reward_violations
from daedalus.actor.environments.components import dtype_misfit, leaves, without
from daedalus.actor.environments.environment_errors import EnvironmentSetupError, raise_problem
from daedalus.actor.environments.info import MASK_KEY
from daedalus.actor.environments.rendering import CountedSteps, FrameRate, frame_rate
from daedalus.policy.user_code import first_line, place_of
from daedalus.policy.user_modules import USER_STATE

Camera = Callable[[np.ndarray, FrameRate], None]

_NUMBERS = (float, int, np.number, np.bool_)
_FLAGS = (bool, np.bool_)
_ARRAYS = (gym.Box, gym.Discrete, gym.MultiDiscrete, gym.MultiBinary)


class Shutter:
    """A camera that films only while it is open."""

    def __init__(self, camera: Camera) -> None:
        self._camera, self.is_open = camera, False

    def __call__(self, picture: np.ndarray, rate: FrameRate) -> None:
        """Pass a picture on."""
        if self.is_open:
            self._camera(picture, rate)


class MaskInInfo(gymnasium.Wrapper):
    """A wrapper that puts the result of the environment's `action_masks()` into `info`."""

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """See gymnasium.Env."""
        observation, info = self.env.reset(seed=seed, options=options)
        return observation, {**info, MASK_KEY: self._mask()}

    def step(self, action: Any) -> tuple[Any, SupportsFloat, bool, bool, dict[str, Any]]:
        """See gymnasium.Env."""
        observation, reward, terminated, truncated, info = self.env.step(action)
        return observation, reward, terminated, truncated, {**info, MASK_KEY: self._mask()}

    def _mask(self) -> Any:
        return self.env.get_wrapper_attr("action_masks")()


class OfItsSpace(gymnasium.Wrapper):
    """A wrapper that refuses an observation which would be another one in a batch with those of other environments.

    To copy it there, gymnasium converts an integer that is too large for the dtype of the space to another number, and
    its shared memory takes other shapes and fractions, too. A reward that is no number is refused, too: what a batch
    makes of it depends on environment.processes. So is an end that is no bool, such as the text "False".
    """

    def __init__(self, environment: gymnasium.Env, name: str, left_out: Sequence[str]) -> None:
        """Construct from the environment, its id, and the names of components that nobody reads."""
        super().__init__(environment)
        self._whose = f"environment {name}"
        self._read_space = without(environment.observation_space, left_out)
        self._leaves = [leaf for leaf in leaves(self._read_space, "observation") if isinstance(leaf.space, _ARRAYS)]
        only = self._read_space
        self._plain = (only.shape, only.dtype) if isinstance(only, _ARRAYS) else None  # of an observation of one array

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """See gymnasium.Env. Raises EnvironmentSetupError, as `step`."""
        with USER_STATE:
            observation, info = self.env.reset(seed=seed, options=options)
        self._check("reset", observation)
        return observation, info

    def step(self, action: Any) -> tuple[Any, SupportsFloat, bool, bool, dict[str, Any]]:
        """See gymnasium.Env."""
        if USER_STATE.differs:  # to enter it takes longer than some environments' steps
            with USER_STATE:
                result = self.env.step(action)
        else:
            result = self.env.step(action)
        self._check("step", result[0])
        if not isinstance(result[1], _NUMBERS):
            raise_problem(self._whose, reward_violations(result[1]))
        if not (isinstance(result[2], _FLAGS) and isinstance(result[3], _FLAGS)):
            raise_problem(self._whose, flag_violations("terminated", result[2]))
            raise_problem(self._whose, flag_violations("truncated", result[3]))
        return result

    def _check(self, call: str, observation: Any) -> None:
        if isinstance(observation, np.ndarray) and (observation.shape, observation.dtype) == self._plain:
            return
        for leaf in self._leaves:
            space = leaf.space
            try:
                array = leaf.of(observation)
            except (KeyError, IndexError, TypeError, ValueError):
                return  # it has no such part: no batch can be made of it, and whoever tries names it
            if array.dtype == space.dtype and array.shape == space.shape:
                continue
            if array.size != np.prod(space.shape or (), dtype=np.int64) or dtype_misfit(space, array):
                raise_problem(self._whose, observation_violations(self._read_space, observation, call))


class RepeatedSteps(gymnasium.Wrapper):
    """A wrapper that repeats each action, passes every frame to a camera, and applies no_reward_limit."""

    def __init__(
        self,
        environment: gymnasium.Env,
        name: str,
        *,
        repeat: int,
        no_reward_limit: int | None,
        is_legal: Callable[[Any, Any, dict[str, Any]], bool] = lambda action, observation, info: True,
        camera: Camera | None = None,
        below: CountedSteps | None = None,
    ) -> None:
        """Construct the wrapper.

        Args:
          environment: one environment.
          name: its id, for errors of the camera.
          repeat: how often each action is taken.
          no_reward_limit: see EnvironmentSpec.
          is_legal: whether an action may be repeated, given the observation and `info` of the step that it made.
          camera: see make_environments.
          below: the environment without the user's wrapper, if it has one.
        """
        super().__init__(environment)
        self._name = name
        self._repeat, self._is_legal = repeat, is_legal
        self._no_reward_limit = no_reward_limit
        self._camera = camera
        self._below, self._skipped = below, 1  # how many steps of `below` the newest step has made
        self._unrewarded = 0  # steps in a row

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """See gymnasium.Env."""
        started = self.env.reset(seed=seed, options=options)
        self._unrewarded = 0
        self._film()
        return started

    def step(self, action: Any) -> tuple[Any, SupportsFloat, bool, bool, dict[str, Any]]:
        """Repeat the action until the episode ends, its mask forbids it or `repeat` is reached, and sum the rewards."""
        observation, total, terminated, truncated, info = self._step_once(action)
        for _ in range(self._repeat - 1):
            if terminated or truncated or not self._is_legal(action, observation, info):
                break
            observation, reward, terminated, truncated, info = self._step_once(action)
            total += reward
        self._unrewarded = 0 if total > 0.0 else self._unrewarded + 1
        if self._no_reward_limit is not None:
            truncated = truncated and not terminated  # gymnasium's time limit sets both at a termination
            if self._unrewarded >= self._no_reward_limit and not terminated:
                terminated = truncated = True
        return observation, total, terminated, truncated, info

    def _step_once(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        # A copy where the action is repeated: the environment may change its values in place.
        given = copy.deepcopy(action) if self._repeat > 1 else action
        before = 0 if self._below is None else self._below.steps
        observation, reward, terminated, truncated, info = self.env.step(given)
        self._skipped = 1 if self._below is None else self._below.steps - before
        self._film()
        return observation, float(reward), terminated, truncated, info

    def _film(self) -> None:
        if self._camera is None:
            return
        try:
            picture = self.env.render()
        except NotImplementedError:
            raise self._unrecorded(" cannot render rgb_array images") from None
        except Exception as error:  # of the user's code
            raise self._unrecorded(f": render raises {first_line(error)}{place_of(error)}") from error
        if not isinstance(picture, np.ndarray):
            raise self._unrecorded(f" renders {type(picture).__name__} instead of an image")
        self._camera(picture, frame_rate(self.env, self._below, self._skipped))

    def _unrecorded(self, reason: str) -> EnvironmentSetupError:
        return EnvironmentSetupError(f"environment {self._name}{reason}: a video of it cannot be recorded")


class OneEpisode(gymnasium.Wrapper):
    """A wrapper that plays one episode for each reset with a seed, and then stands still.

    A reset without a seed, by which a vector environment begins the next episode, costs nothing here, and the steps
    after it neither.
    """

    _over = False
    _last: Any = None  # the last observation of the episode
    _mask: Any = None  # its last action mask; None if it has none

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Begin an episode if a seed is given, else return the last observation."""
        if seed is None:
            return self._last, self._still()
        self._over = False
        return self.env.reset(seed=seed, options=options)

    def step(self, action: Any) -> tuple[Any, SupportsFloat, bool, bool, dict[str, Any]]:
        """See gymnasium.Env. After the episode, return the last observation and no reward."""
        if self._over:
            return self._last, 0.0, False, False, self._still()
        self._last, reward, terminated, truncated, info = self.env.step(action)
        self._over = terminated or truncated
        self._mask = info.get(MASK_KEY, self._mask)
        return self._last, reward, terminated, truncated, info

    def _still(self) -> dict[str, Any]:
        """Return the `info` after the episode: masks of a batch that lacks one cannot always be put together."""
        return {} if self._mask is None else {MASK_KEY: self._mask}
