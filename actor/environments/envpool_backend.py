"""Backend `envpool`: many environments in one C++ pool, on one thread."""

import math
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from typing import Any

import gymnasium
import numpy as np
from gymnasium.vector.utils import create_empty_array

from daedalus.actor.environments.environment_errors import (
    OTHER_BACKEND,
    EnvironmentSetupError,
    import_extra,
    unknown_environment,
)
from daedalus.policy.user_code import first_line
from daedalus.protocol.spec import EnvironmentSpec

_ATARI_OPTIONS = {"stack_num", "frame_skip", "gray_scale", "img_height", "img_width", "reward_clip"}
_ATARI_SIZE = (210, 160)
_ATARI_FRAMES = 108_000  # half an hour, as in ALE; envpool's own limit counts steps, however many frames they repeat

_ALL = slice(None)

Arrange = Callable[[np.ndarray], np.ndarray]
Frames = Any  # an array [E, *frame_shape], or a map of these by component, nested as the observation space is
Rows = np.ndarray | slice


class EnvpoolEnvironments:
    """A BackendEnvironments over an envpool pool.

    Ended episodes are reset by index, as the pool's own autoreset does.
    """

    action_mask = None

    def __init__(
        self,
        envpool: Any,
        name: str,
        options: dict[str, Any],
        *,
        repeat: int = 1,
        no_reward_limit: int | None = None,
        arrange: Arrange = np.asarray,
    ) -> None:
        """Prepare a pool, which the first `reset` creates.

        Args:
          envpool: the module.
          name: of the environment.
          options: of the pool.
          repeat: how often each action is repeated here.
          no_reward_limit: end an episode after so many steps in a row without a positive reward.
          arrange: turns the arrays of the pool's observations into frames [E, *frame_shape].
        """
        self.count: int = options["num_envs"]
        self._make_pool = partial(envpool.make_gymnasium, name, **options)
        self._pool: Any = None  # created by `reset`, because it takes its seed at construction
        with _no_warnings():
            spec = envpool.make_spec(name, **options)
            self.observation_space: gymnasium.Space = _arranged(spec.gymnasium_observation_space, arrange)
            self.action_space: gymnasium.Space = spec.gymnasium_action_space
        self._arrange = arrange
        self._repeat = repeat
        self._no_reward_limit = no_reward_limit
        self._ended = np.zeros(self.count, np.bool_)
        self._unrewarded = np.zeros(self.count, np.int64)  # steps in a row

    def reset(self, seed: int) -> Frames:
        """See BackendEnvironments."""
        self.close()
        with _no_warnings():
            self._pool = self._make_pool(seed=seed % (2**31 - self.count))  # environment e gets the int32 seed + e
            observations, _ = self._pool.reset()
        self._ended[:] = False
        self._unrewarded[:] = 0
        frames = self._empty_frames()
        self._write(frames, _ALL, observations, _ALL)
        return frames

    def step(self, actions: np.ndarray) -> tuple[Frames, np.ndarray, np.ndarray, np.ndarray]:
        """See BackendEnvironments."""
        frames = self._empty_frames()
        rewards = np.zeros(self.count)
        terminated, truncated = np.zeros((2, self.count), np.bool_)
        ended, live = np.flatnonzero(self._ended), np.flatnonzero(~self._ended)
        if len(ended):
            self._write(frames, ended, self._pool.reset(ended)[0], _ALL)
        for repeats_left in reversed(range(self._repeat)):
            if not len(live):
                break
            shown, earned, over, cut, _ = self._pool.step(actions[live], live)
            rewards[live] += earned
            terminated[live], truncated[live] = over, cut
            last = (over | cut) if repeats_left else np.ones(len(live), np.bool_)
            self._write(frames, live[last], shown, last)
            live = live[~last]
        if self._no_reward_limit is not None:
            self._unrewarded = np.where((rewards > 0.0) | self._ended, 0, self._unrewarded + 1)
            ended = (self._unrewarded >= self._no_reward_limit) & ~terminated
            truncated = (truncated & ~terminated) | ended
            terminated |= ended
        self._ended = terminated | truncated
        return frames, rewards, terminated, truncated

    def _empty_frames(self) -> Frames:
        return create_empty_array(self.observation_space, self.count, np.empty)

    def _write(self, frames: Frames, environments: Rows, observations: Frames, rows: Rows) -> None:
        """Write rows of the pool's observations to the frames of these environments."""
        if isinstance(observations, dict):
            for name, part in observations.items():
                self._write(frames[name], environments, part, rows)
        else:
            frames[environments] = self._arrange(observations[rows])

    def take_episode_info(self) -> dict[str, np.ndarray]:
        """See BackendEnvironments. The `info` of this backend has only numbers of its own, such as frame counts."""
        return {}

    def close(self) -> None:
        """See BackendEnvironments."""
        if self._pool is not None:
            self._pool.close()
            self._pool = None


def make_envpool(spec: EnvironmentSpec, count: int) -> tuple[EnvpoolEnvironments, EnvironmentSpec]:
    """Return the environments, and the specification without what the pool does itself.

    For Atari games the pool repeats, greys and resizes.

    Raises EnvironmentSetupError; its message is one line.
    """
    with _no_warnings():
        envpool = import_extra("envpool", "envpool", "environment.backend=envpool", OTHER_BACKEND)
    names = envpool.list_all_envs()
    if spec.id not in names:
        raise unknown_environment(spec.id, names, "envpool has none like it; use --set environment.backend=gymnasium")
    try:
        with _no_warnings():
            config = envpool.make_spec(spec.id).config
        if set(config._fields) >= _ATARI_OPTIONS:
            return _make_atari(envpool, spec, count)
        limit = {} if spec.max_episode_steps is None else {"max_episode_steps": spec.max_episode_steps}
        options = _options(spec, count, limit)
        bare = EnvpoolEnvironments(
            envpool, spec.id, options, repeat=spec.action_repeat, no_reward_limit=spec.no_reward_limit
        )
        return bare, spec
    except EnvironmentSetupError:
        raise
    except Exception as error:  # broad: envpool's options raise many kinds of exception without a common base
        raise EnvironmentSetupError(
            f"environment {spec.id} of envpool cannot be created: {first_line(error)}"
        ) from error


def _make_atari(envpool: Any, spec: EnvironmentSpec, count: int) -> tuple[EnvpoolEnvironments, EnvironmentSpec]:
    cropped = spec.crop is not None  # envpool does not crop, and cropping comes before resizing
    height, width = _ATARI_SIZE if cropped or spec.resize is None else spec.resize
    options = _options(
        spec,
        count,
        {
            "stack_num": 1,
            "frame_skip": spec.action_repeat,
            "gray_scale": spec.grey,
            "img_height": height,
            "img_width": width,
            "reward_clip": False,
            "max_episode_steps": math.ceil((spec.max_episode_steps or _ATARI_FRAMES) / spec.action_repeat),
        },
    )
    bare = EnvpoolEnvironments(
        envpool, spec.id, options, no_reward_limit=spec.no_reward_limit, arrange=_grey if spec.grey else _colour
    )
    left = {"action_repeat": 1, "grey": False, "resize": spec.resize if cropped else None}
    return bare, spec.model_copy(update=left)


def _arranged(space: gymnasium.Space, arrange: Arrange) -> gymnasium.Space:
    if not isinstance(space, gymnasium.spaces.Box):
        return space
    low, high = arrange(space.low[None])[0], arrange(space.high[None])[0]
    return gymnasium.spaces.Box(low, high, dtype=space.dtype.type)


def _grey(observations: np.ndarray) -> np.ndarray:
    return observations[:, 0]  # [E, 1, H, W]


def _colour(observations: np.ndarray) -> np.ndarray:
    return np.moveaxis(observations, 1, 3)  # [E, 3, H, W]


def _options(spec: EnvironmentSpec, count: int, ours: dict[str, Any]) -> dict[str, Any]:
    """Return a pool's options: the user's and ours. Raises EnvironmentSetupError if both name the same one."""
    ours = {**ours, "num_envs": count, "batch_size": count, "num_threads": 1}
    if conflicting := sorted(ours.keys() & spec.constructor_kwargs.keys()):
        raise EnvironmentSetupError(
            f"environment.kwargs of envpool's {spec.id} names {' and '.join(conflicting)}, "
            "but other settings decide that: leave it out of kwargs"
        )
    return {**spec.constructor_kwargs, **ours}


@contextmanager
def _no_warnings() -> Iterator[None]:
    """Suppress envpool's warnings about the precision of its own spaces."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)
        yield
