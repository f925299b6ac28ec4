"""EnvironmentSpec -> vectorised environment, behind one small interface.

All step under gymnasium's NEXT_STEP rule: the step after an episode's end ignores its action and resets.
"""

import difflib
import importlib
import os
import sys
from typing import Any, Protocol

import gymnasium
import numpy as np
from gymnasium.envs.registration import EnvSpec
from gymnasium.vector import AutoresetMode

from protocol.spec import ArraySpace, ChoiceSpace, EnvironmentSpec, Spaces


class UnplayableError(Exception):
    """The environment cannot be played; the message says why and what to do."""


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
        """Starts an episode in each; returns observations [E, *observation_shape]."""
        ...

    def step(self, actions: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Takes one action [E] in each.

        Returns: observations [E, *observation_shape], unscaled rewards [E], terminated [E], truncated [E].
        Where the last step ended an episode this one only resets: reward 0 and the first observation.
        """
        ...

    def close(self) -> None:
        """Ends them."""
        ...


class GymnasiumEnvironment:
    """A gymnasium vector environment whose spaces travel."""

    def __init__(self, environment: Any) -> None:
        self._environment = environment
        self._spaces = _travelling_spaces(environment)
        self._start = int(getattr(environment.single_action_space, "start", 0))

    @property
    def count(self) -> int:
        """See VectorEnvironment."""
        return self._environment.num_envs

    @property
    def spaces(self) -> Spaces:
        """See VectorEnvironment."""
        return self._spaces

    def reset(self, seed: int) -> np.ndarray:
        """See VectorEnvironment."""
        return self._environment.reset(seed=seed)[0]

    def step(self, actions: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """See VectorEnvironment."""
        if self._start:
            actions = actions + self._start
        observations, rewards, terminated, truncated, _ = self._environment.step(actions)
        return observations, rewards, terminated, truncated

    def close(self) -> None:
        """See VectorEnvironment."""
        self._environment.close()


def make_environments(spec: EnvironmentSpec, count: int) -> VectorEnvironment:
    """`count` environments of one kind: by the environment's own vector entry point if it has one, else in turn.

    Raises UnplayableError with one line that says what is wrong and what to do.
    """
    registered = _registered(spec.id)
    kwargs: dict[str, Any] = dict(spec.kwargs)
    if spec.max_episode_steps is not None:
        kwargs["max_episode_steps"] = spec.max_episode_steps
    try:
        if registered.vector_entry_point is not None:
            environment = gymnasium.make_vec(registered, count, "vector_entry_point", **kwargs)
        else:
            environment = gymnasium.make_vec(
                registered,
                count,
                "sync",
                vector_kwargs={"autoreset_mode": AutoresetMode.NEXT_STEP},
                disable_env_checker=True,  # it costs a tenth of the speed, and warns on behalf of others
                **kwargs,
            )
    except gymnasium.error.DependencyNotInstalled as error:
        raise UnplayableError(
            f"environment {spec.id} needs a package that is not installed: {str(error).splitlines()[0]}"
        ) from None
    except Exception as error:  # whatever a user's own environment raises
        raise UnplayableError(f"environment {spec.id} cannot be made: {type(error).__name__}: {error}") from None
    if environment.metadata.get("autoreset_mode") is not AutoresetMode.NEXT_STEP:
        environment.close()
        raise UnplayableError(
            f"environment {spec.id} resets by {environment.metadata.get('autoreset_mode')}: "
            "its vector entry point must follow gymnasium's AutoresetMode.NEXT_STEP"
        )
    try:
        return GymnasiumEnvironment(environment)
    except UnplayableError:
        environment.close()
        raise


def _registered(environment_id: str) -> EnvSpec:
    """gymnasium's registration of `[module:]id`; the module may lie in the working directory."""
    module, _, name = environment_id.rpartition(":")
    if module:
        if os.getcwd() not in sys.path:
            sys.path.append(os.getcwd())
        try:
            importlib.import_module(module)
        except ImportError as error:
            raise UnplayableError(
                f"environment {environment_id}: cannot import {module} ({error}): "
                "it must lie in the working directory or be installed"
            ) from None
    try:
        return gymnasium.spec(name)
    except gymnasium.error.Error:
        near = difflib.get_close_matches(name, gymnasium.registry.keys(), 3, 0.5)
        hint = (
            f"did you mean {' or '.join(near)}?"
            if near
            else "is its package installed and its module named (module:Id)?"
        )
        raise UnplayableError(f"unknown environment {name!r}: {hint}") from None


def _travelling_spaces(environment: Any) -> Spaces:
    observation, action = environment.single_observation_space, environment.single_action_space
    if not isinstance(observation, gymnasium.spaces.Box) or not observation.shape:
        raise UnplayableError(
            f"observation space {observation} is not supported: it must be a Box of at least one dimension"
        )
    if not isinstance(action, gymnasium.spaces.Discrete):
        raise UnplayableError(f"action space {action} is not supported: it must be Discrete")
    dtype = "uint8" if observation.dtype == np.uint8 else "float32"
    return Spaces(observation=ArraySpace(shape=observation.shape, dtype=dtype), action=ChoiceSpace(count=int(action.n)))
