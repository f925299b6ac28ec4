"""gymnasium's environments, and every environment that a user registers with it."""

import importlib
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import Any, SupportsFloat

import gymnasium
import numpy as np
from gymnasium.envs.registration import EnvSpec
from gymnasium.vector import AutoresetMode, SyncVectorEnv

from daedalus.actor.environments.environment_errors import (
    EnvironmentSetupError,
    first_line,
    import_extra,
    import_user_module,
    unknown_environment,
)
from daedalus.actor.environments.environment_processes import EnvironmentProcesses
from daedalus.protocol.spec import EnvironmentSpec

Camera = Callable[[np.ndarray], None]

_CAR_RACING = "gymnasium.envs.box2d.car_racing:CarRacing"


class GymnasiumEnvironments:
    """A gymnasium vector environment as a BackendEnvironments."""

    def __init__(self, environment: Any) -> None:
        self._environment = environment
        self.count: int = environment.num_envs
        self.observation_space: gymnasium.Space = environment.single_observation_space
        self.action_space: gymnasium.Space = environment.single_action_space

    def reset(self, seed: int) -> np.ndarray:
        """See BackendEnvironments."""
        return self._environment.reset(seed=seed)[0]

    def step(self, actions: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """See BackendEnvironments."""
        return self._environment.step(actions)[:4]

    def close(self) -> None:
        """See BackendEnvironments."""
        self._environment.close()


class RepeatedSteps(gymnasium.Wrapper):
    """Repeats each action, shows every step to a camera, and cuts an episode that no_reward_limit has run out for."""

    def __init__(
        self, environment: gymnasium.Env, *, repeat: int, no_reward_limit: int | None, camera: Camera | None = None
    ) -> None:
        super().__init__(environment)
        self._repeat = repeat
        self._no_reward_limit = no_reward_limit
        self._camera = camera
        self._unrewarded = 0  # steps in a row

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Starts an episode."""
        started = self.env.reset(seed=seed, options=options)
        self._unrewarded = 0
        self._show()
        return started

    def step(self, action: Any) -> tuple[Any, SupportsFloat, bool, bool, dict[str, Any]]:
        """Steps until the action has been repeated often enough or the episode ends; rewards are summed."""
        observation, total, terminated, truncated, info = self._step_once(action)
        for _ in range(self._repeat - 1):
            if terminated or truncated:
                break
            observation, reward, terminated, truncated, info = self._step_once(action)
            total += reward
        self._unrewarded = 0 if total > 0.0 else self._unrewarded + 1
        if self._no_reward_limit is not None and self._unrewarded >= self._no_reward_limit and not terminated:
            truncated = True
        return observation, total, terminated, truncated, info

    def _step_once(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        observation, reward, terminated, truncated, info = self.env.step(action)
        self._show()
        return observation, float(reward), terminated, truncated, info

    def _show(self) -> None:
        if self._camera is None:
            return
        picture = self.env.render()
        if not isinstance(picture, np.ndarray):
            raise EnvironmentSetupError(
                f"{self.env} renders no picture, but {type(picture).__name__}: it cannot be filmed"
            )
        self._camera(picture)


@dataclass(frozen=True, slots=True, kw_only=True)
class EnvironmentFactory:
    """Makes one environment, here or in a process of its own."""

    spec: EnvironmentSpec
    wrap: str | None = None
    render_mode: str | None = None
    camera: Camera | None = None

    def __call__(self) -> gymnasium.Env:
        """One environment; whatever it raises when it is made."""
        spec, registered = self.spec, registration(self.spec.id)
        kwargs = _kwargs(spec)
        if self.render_mode is not None:
            kwargs["render_mode"] = self.render_mode
        drawn_late = registered.entry_point == _CAR_RACING and self.wrap is None
        environment = gymnasium.make(
            _late_rendered(registered, spec.backend) if drawn_late else registered,
            disable_env_checker=True,  # it costs a tenth of the speed, and warns on behalf of others
            **kwargs,
        )
        if self.wrap is not None:
            environment = _wrapped(environment, self.wrap)
        if spec.action_repeat > 1 or spec.no_reward_limit is not None or self.camera is not None:
            environment = RepeatedSteps(
                environment, repeat=spec.action_repeat, no_reward_limit=spec.no_reward_limit, camera=self.camera
            )
        if drawn_late:
            from daedalus.actor.environments.car_racing import RenderObservation  # needs packages that are optional

            environment = RenderObservation(environment)
        return environment

    @property
    def is_plain(self) -> bool:
        """Whether nothing is asked of each environment by itself, so that its own vectorised form will do."""
        spec = self.spec
        of_each = (spec.no_reward_limit, self.wrap, self.render_mode, self.camera)
        return spec.action_repeat == 1 and not spec.processes and all(asked is None for asked in of_each)


def make_gymnasium(
    spec: EnvironmentSpec,
    count: int,
    *,
    wrap: str | None = None,
    render_mode: str | None = None,
    camera: Camera | None = None,
) -> GymnasiumEnvironments:
    """By the environment's own vector entry point if it has one that will do, else in turn, else in processes."""
    if spec.backend == "fast" and registration(spec.id).entry_point != _CAR_RACING:
        raise EnvironmentSetupError(
            f"environment.backend=fast draws CarRacing-v3 only, not {spec.id}: --set environment.backend=gymnasium"
        )
    if camera is not None and (count != 1 or render_mode != "rgb_array"):
        raise ValueError("a camera films one environment in render_mode 'rgb_array'")
    try:
        environment = _make_vector(
            EnvironmentFactory(spec=spec, wrap=wrap, render_mode=render_mode, camera=camera), count
        )
    except EnvironmentSetupError:
        raise
    except gymnasium.error.DependencyNotInstalled as error:
        box2d = "box2d" in str(error).lower()
        remedy = 'pip install "daedalus-rl[box2d]"' if box2d else str(error).splitlines()[0]
        raise EnvironmentSetupError(f"environment {spec.id} needs a package that is not installed: {remedy}") from None
    except Exception as error:  # whatever a user's own environment raises
        raise EnvironmentSetupError(f"environment {spec.id} cannot be made: {first_line(error)}") from None
    if environment.metadata.get("autoreset_mode") is not AutoresetMode.NEXT_STEP:
        environment.close()
        raise EnvironmentSetupError(
            f"environment {spec.id} resets by {environment.metadata.get('autoreset_mode')}: "
            "its vector entry point must follow gymnasium's AutoresetMode.NEXT_STEP"
        )
    return GymnasiumEnvironments(environment)


def registration(environment_id: str) -> EnvSpec:
    """gymnasium's registration of `[module:]id`; the module may lie in the working directory."""
    module, _, name = environment_id.rpartition(":")
    if module:
        import_user_module(module, f"environment {environment_id}")
    elif name.startswith("ALE/"):
        gymnasium.register_envs(import_extra("ale_py", "atari", f"environment {name}"))  # importing it registers them
    try:
        return gymnasium.spec(name)
    except gymnasium.error.Error:
        raise unknown_environment(
            name, gymnasium.registry.keys(), "is its package installed and its module named (module:Id)?"
        ) from None


def as_on_gymnasium(spec: EnvironmentSpec) -> EnvironmentSpec:
    """Return the specification for an evaluation on gymnasium's implementation of the environment.

    Atari games of the other backends have another name there, and repeat actions unless told not to.
    """
    evaluated = spec.as_evaluated("gymnasium")
    if spec.backend == "gymnasium":
        return evaluated
    atari_id = f"ALE/{spec.id.removeprefix('ALE/').removesuffix('-v5')}-v5"
    with suppress(ImportError):
        gymnasium.register_envs(importlib.import_module("ale_py"))
    if atari_id not in gymnasium.registry:
        return evaluated
    kwargs = {"frameskip": 1, "repeat_action_probability": 0.0}  # as the others have it by default
    return evaluated.model_copy(update={"id": atari_id, "kwargs": kwargs})


def _late_rendered(registered: EnvSpec, backend: str) -> EnvSpec:
    """CarRacing's registration, for one that draws late: most of its time goes into frames that nobody sees."""
    from daedalus.actor.environments.car_racing import FastCarRacing, LateRenderedCarRacing

    return replace(registered, entry_point=FastCarRacing if backend == "fast" else LateRenderedCarRacing)


def _make_vector(factory: EnvironmentFactory, count: int) -> Any:
    spec, registered = factory.spec, registration(factory.spec.id)
    # ALE's vectorised form is another environment: it stacks, shrinks and clips by itself (that is backend=ale).
    if registered.vector_entry_point is not None and registered.namespace != "ALE" and factory.is_plain:
        return gymnasium.make_vec(registered, count, "vector_entry_point", **_kwargs(spec))
    if spec.processes and spec.backend == "gymnasium" and factory.camera is None:
        return EnvironmentProcesses([factory] * count)
    return SyncVectorEnv([factory] * count, autoreset_mode=AutoresetMode.NEXT_STEP)


def _kwargs(spec: EnvironmentSpec) -> dict[str, Any]:
    limit = {} if spec.max_episode_steps is None else {"max_episode_steps": spec.max_episode_steps}
    return {**spec.kwargs, **limit}


def _wrapped(environment: gymnasium.Env, wrap: str) -> gymnasium.Env:
    module, _, name = wrap.rpartition(":")
    function = getattr(import_user_module(module, f"wrap {wrap}"), name, None) if module else None
    if not callable(function):
        raise EnvironmentSetupError(f"wrap {wrap}: there is no such function; name it as module:function")
    wrapped = function(environment)
    if not isinstance(wrapped, gymnasium.Env):
        raise EnvironmentSetupError(
            f"wrap {wrap} made {type(wrapped).__name__} of {environment}: it must be a gymnasium.Env"
        )
    return wrapped
