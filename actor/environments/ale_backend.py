"""Backend `ale`: Atari games by the Arcade Learning Environment's own vector environment."""

import re
from typing import Any

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
