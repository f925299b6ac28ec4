"""One environment of any backend behind gymnasium's interface of a single environment."""

from contextlib import suppress
from typing import Any

import gymnasium

from daedalus.actor.environments.components import batch_of_one, only_of_batch
from daedalus.actor.environments.environment_errors import EnvironmentSetupError
from daedalus.actor.environments.gymnasium_backend import make_single
from daedalus.actor.environments.interface import BackendEnvironments
from daedalus.actor.environments.make import make_bare
from daedalus.actor.environments.masks import MASK_KEY, only_of_masks
from daedalus.policy.user_code import first_line
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
            observations = self._environments.step(self._batched(self.action_space.sample()))[0]
        else:
            observations, self._started = self._environments.reset(seed or 0), True
        return only_of_batch(self.observation_space, observations), self._info()

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """See gymnasium.Env."""
        observations, rewards, terminated, truncated = self._environments.step(self._batched(action))
        observation = only_of_batch(self.observation_space, observations)
        return observation, float(rewards[0]), bool(terminated[0]), bool(truncated[0]), self._info()

    def _batched(self, action: Any) -> Any:
        return batch_of_one(self.action_space, action, "the action")

    def _info(self) -> dict[str, Any]:
        mask = self._environments.action_mask
        return {} if mask is None else {MASK_KEY: only_of_masks(mask)}

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
        _check_spaces(single, spec.id)
        return single, spec
    environments, rest = make_bare(spec.model_copy(update={"processes": False}), 1, modules)
    return OneOfVector(environments), rest


def _check_spaces(environment: gymnasium.Env, name: str) -> None:
    """Close an environment whose spaces cannot be read, and raise EnvironmentSetupError."""
    for attribute in ("observation_space", "action_space"):
        try:
            getattr(environment, attribute)
        except (Exception, SystemExit) as error:  # of the user's code
            with suppress(Exception, SystemExit):
                environment.close()
            raise EnvironmentSetupError(
                f"environment {name} has no {attribute} ({first_line(error)}): set it in the constructor"
            ) from None
