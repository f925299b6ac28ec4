"""Atari games on gymnasium with the frames and the starts that they have on the backends `ale` and `envpool`."""

import re
from typing import Any, SupportsFloat

import gymnasium
import numpy as np

from daedalus.actor.environments.environment_errors import (
    OTHER_BACKEND,
    EnvironmentSetupError,
    import_extra,
    unknown_environment,
)
from daedalus.policy.user_code import first_line
from daedalus.protocol.spec import EnvironmentSpec

_SIZE = (210, 160)
_PURPOSE = "environment.backend=ale"


class AleEnvironments:
    """A BackendEnvironments over an AtariVectorEnv with stacks of one frame."""

    action_mask = None

    def __init__(self, environment: Any) -> None:
        self._environment = environment
        self.count: int = environment.num_envs
        shape = environment.single_observation_space.shape[1:]
        self.observation_space = gymnasium.spaces.Box(0, 255, shape, np.uint8)
        self.action_space: gymnasium.Space = environment.single_action_space

    def reset(self, seed: int) -> np.ndarray:
        """See BackendEnvironments."""
        observations, _ = self._environment.reset(seed=seed % (2**31 - self.count))  # environment e gets int32 seed + e
        return observations[:, 0]

    def step(self, actions: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """See BackendEnvironments."""
        observations, rewards, terminated, truncated, _ = self._environment.step(actions)
        return observations[:, 0], rewards, terminated, truncated

    def take_episode_info(self) -> dict[str, np.ndarray]:
        """See BackendEnvironments. The `info` of this backend has only numbers of its own, such as frame counts."""
        return {}

    def close(self) -> None:
        """See BackendEnvironments."""
        self._environment.close()


def make_ale(spec: EnvironmentSpec, count: int) -> tuple[AleEnvironments, EnvironmentSpec]:
    """Return the environments, and the specification without what ALE does itself: repeat, grey and resize.

    Raises EnvironmentSetupError; its message is one line.
    """
    for field in ("action_table", "no_reward_limit", "crop"):
        if getattr(spec, field) is not None:
            raise EnvironmentSetupError(
                f"environment.backend=ale does not support environment.{field}: "
                "leave it out, or use --set environment.backend=gymnasium"
            )
    roms = import_extra("ale_py.roms", "atari", _PURPOSE, OTHER_BACKEND)
    vector = import_extra("ale_py.vector_env", "atari", _PURPOSE, OTHER_BACKEND)
    height, width = spec.resize or _SIZE
    limit = {} if spec.max_episode_steps is None else {"max_num_frames_per_episode": spec.max_episode_steps}
    game = _game(spec.id, roms.get_all_rom_ids())
    try:
        environment = vector.AtariVectorEnv(
            game,
            count,
            num_threads=1,
            stack_num=1,
            frameskip=spec.action_repeat,
            grayscale=spec.grey,
            img_height=height,
            img_width=width,
            reward_clipping=False,
            maxpool=True,
            autoreset_mode=gymnasium.vector.AutoresetMode.NEXT_STEP,
            **limit,
            **spec.constructor_kwargs,
        )
    except Exception as error:  # broad: ALE's options raise many kinds of exception without a common base
        raise EnvironmentSetupError(f"environment {spec.id} of ale cannot be created: {first_line(error)}") from error
    return AleEnvironments(environment), spec.model_copy(update={"action_repeat": 1, "grey": False, "resize": None})


def _game(environment_id: str, games: list[str]) -> str:
    """Return ALE's own name of a game, `ms_pacman` for `ALE/MsPacman-v5`, `MsPacman-v5` or `MsPacman`."""
    name = re.fullmatch(r"(?:ALE/)?(.*?)(?:-v\d+)?", environment_id, re.DOTALL)
    assert name is not None
    by_name = {"".join(word.capitalize() for word in game.split("_")): game for game in games}
    for known, game in by_name.items():
        if name[1].replace("_", "").lower() == known.lower():
            return game
    raise unknown_environment(environment_id, by_name, "ALE has no similar game")


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


def repeated_twice(environment: gymnasium.Env, action_repeat: int) -> str:
    """Return a warning if the run repeats the actions of a game that repeats them itself, or an empty string."""
    registered = environment.spec
    if action_repeat == 1 or registered is None or not str(registered.entry_point).startswith("ale_py"):
        return ""
    frames = registered.kwargs.get("frameskip", 4)
    if frames == 1:
        return ""
    return (
        f"the run takes each action {action_repeat} times (environment.action_repeat), and the game shows it for "
        f"{frames} frames each time itself: leave action_repeat out, or use --set environment.kwargs.frameskip=1"
    )
