"""One environment of any backend behind gymnasium's interface of a single environment."""

from typing import Any

import gymnasium
import numpy as np

from daedalus.actor.environments.environment_errors import EnvironmentSetupError
from daedalus.actor.environments.gymnasium_backend import make_single
from daedalus.actor.environments.interface import BackendEnvironments
from daedalus.actor.environments.make import make_bare
from daedalus.policy.user_modules import UserModuleError, UserModules
from daedalus.protocol.spec import EnvironmentSpec


class OneOfVector(gymnasium.Env):
    """The only environment of a vector: its steps after the end of an episode are resets here."""

    def __init__(self, environments: BackendEnvironments) -> None:
        self._environments = environments
        self.observation_space, self.action_space = environments.observation_space, environments.action_space
        self._started = False

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Begin the next episode; only the first one has a seed."""
        if self._started:
            frames = self._environments.step(np.asarray(self.action_space.sample())[None])[0]
        else:
            frames, self._started = self._environments.reset(seed or 0), True
        return frames[0], {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """See gymnasium.Env."""
        frames, rewards, terminated, truncated = self._environments.step(np.asarray(action)[None])
        return frames[0], float(rewards[0]), bool(terminated[0]), bool(truncated[0]), {}

    def close(self) -> None:
        """See gymnasium.Env."""
        self._environments.close()


def make_one(spec: EnvironmentSpec, modules: UserModules) -> tuple[gymnasium.Env, EnvironmentSpec]:
    """Return one environment in this process, and the specification without what the backend does itself.

    Raises EnvironmentSetupError.
    """
    try:
        modules.check(spec.user_modules)
    except UserModuleError as error:
        raise EnvironmentSetupError(str(error)) from None
    single = make_single(spec, modules) if spec.backend in ("gymnasium", "fast") else None
    if single is not None:
        return single, spec
    environments, rest = make_bare(spec.model_copy(update={"processes": False}), 1, modules)
    return OneOfVector(environments), rest
