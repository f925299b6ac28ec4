"""gymnasium's environments, and every environment that a user registers with it."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, SupportsFloat

import gymnasium
import numpy as np
from gymnasium.envs.registration import EnvSpec
from gymnasium.vector import AutoresetMode, SyncVectorEnv

from daedalus.actor.environments.environment_errors import (
    UnplayableError,
    first_line,
    import_extra,
    import_own,
    unknown_environment,
)
from daedalus.actor.environments.environment_processes import EnvironmentProcesses
from daedalus.protocol.spec import EnvironmentSpec

Camera = Callable[[np.ndarray], None]

_CAR_RACING = "gymnasium.envs.box2d.car_racing:CarRacing"


class GymnasiumEnvironments:
    """A gymnasium vector environment as a BareEnvironment."""

    def __init__(self, environment: Any) -> None:
        self._environment = environment
        self.count: int = environment.num_envs
        self.observation_space: gymnasium.Space = environment.single_observation_space
        self.action_space: gymnasium.Space = environment.single_action_space

    def reset(self, seed: int) -> np.ndarray:
        """See BareEnvironment."""
        return self._environment.reset(seed=seed)[0]

    def step(self, actions: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """See BareEnvironment."""
        return self._environment.step(actions)[:4]

    def close(self) -> None:
        """See BareEnvironment."""
        self._environment.close()


class RepeatedSteps(gymnasium.Wrapper):
    """Repeats each action, shows every step to a camera, and cuts an episode that patience has run out for."""

    def __init__(
        self, environment: gymnasium.Env, *, repeat: int, patience: int | None, camera: Camera | None = None
    ) -> None:
        super().__init__(environment)
        self._repeat = repeat
        self._patience = patience
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
        if self._patience is not None and self._unrewarded >= self._patience and not terminated:
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
            raise UnplayableError(f"{self.env} renders no picture, but {type(picture).__name__}: it cannot be filmed")
        self._camera(picture)


@dataclass(frozen=True, slots=True, kw_only=True)
class MakeOne:
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
            _undrawn(registered, spec.backend) if drawn_late else registered,
            disable_env_checker=True,  # it costs a tenth of the speed, and warns on behalf of others
            **kwargs,
        )
        if self.wrap is not None:
            environment = _wrapped(environment, self.wrap)
        if spec.action_repeat > 1 or spec.patience is not None or self.camera is not None:
            environment = RepeatedSteps(
                environment, repeat=spec.action_repeat, patience=spec.patience, camera=self.camera
            )
        if drawn_late:
            from daedalus.actor.environments.car_racing import Drawn  # needs packages that are optional

            environment = Drawn(environment)
        return environment

    @property
    def is_plain(self) -> bool:
        """Whether nothing is asked of each environment by itself, so that its own vectorised form will do."""
        spec = self.spec
        of_each = (spec.patience, self.wrap, self.render_mode, self.camera)
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
    if spec.backend == "sketch" and registration(spec.id).entry_point != _CAR_RACING:
        raise UnplayableError(
            f"environment.backend=sketch draws CarRacing-v3 only, not {spec.id}: --set environment.backend=gymnasium"
        )
    if camera is not None and (count != 1 or render_mode != "rgb_array"):
        raise ValueError("a camera films one environment in render_mode 'rgb_array'")
    try:
        environment = _make_vector(MakeOne(spec=spec, wrap=wrap, render_mode=render_mode, camera=camera), count)
    except UnplayableError:
        raise
    except gymnasium.error.DependencyNotInstalled as error:
        box2d = "box2d" in str(error).lower()
        remedy = 'pip install "daedalus-rl[box2d]"' if box2d else str(error).splitlines()[0]
        raise UnplayableError(f"environment {spec.id} needs a package that is not installed: {remedy}") from None
    except Exception as error:  # whatever a user's own environment raises
        raise UnplayableError(f"environment {spec.id} cannot be made: {first_line(error)}") from None
    if environment.metadata.get("autoreset_mode") is not AutoresetMode.NEXT_STEP:
        environment.close()
        raise UnplayableError(
            f"environment {spec.id} resets by {environment.metadata.get('autoreset_mode')}: "
            "its vector entry point must follow gymnasium's AutoresetMode.NEXT_STEP"
        )
    return GymnasiumEnvironments(environment)


def registration(environment_id: str) -> EnvSpec:
    """gymnasium's registration of `[module:]id`; the module may lie in the working directory."""
    module, _, name = environment_id.rpartition(":")
    if module:
        import_own(module, f"environment {environment_id}")
    elif name.startswith("ALE/"):
        gymnasium.register_envs(import_extra("ale_py", "atari", f"environment {name}"))  # importing it registers them
    try:
        return gymnasium.spec(name)
    except gymnasium.error.Error:
        raise unknown_environment(
            name, gymnasium.registry.keys(), "is its package installed and its module named (module:Id)?"
        ) from None


def _undrawn(registered: EnvSpec, backend: str) -> EnvSpec:
    """CarRacing's registration, for one that draws late: most of its time goes into frames that nobody sees."""
    from daedalus.actor.environments.car_racing import SketchedCarRacing, UndrawnCarRacing

    return replace(registered, entry_point=SketchedCarRacing if backend == "sketch" else UndrawnCarRacing)


def _make_vector(make_one: MakeOne, count: int) -> Any:
    spec, registered = make_one.spec, registration(make_one.spec.id)
    # ALE's vectorised form is another environment: it stacks, shrinks and clips by itself (that is backend=ale).
    if registered.vector_entry_point is not None and registered.namespace != "ALE" and make_one.is_plain:
        return gymnasium.make_vec(registered, count, "vector_entry_point", **_kwargs(spec))
    if spec.processes and spec.backend == "gymnasium" and make_one.camera is None:
        return EnvironmentProcesses([make_one] * count)
    return SyncVectorEnv([make_one] * count, autoreset_mode=AutoresetMode.NEXT_STEP)


def _kwargs(spec: EnvironmentSpec) -> dict[str, Any]:
    limit = {} if spec.max_episode_steps is None else {"max_episode_steps": spec.max_episode_steps}
    return {**spec.kwargs, **limit}


def _wrapped(environment: gymnasium.Env, wrap: str) -> gymnasium.Env:
    module, _, name = wrap.rpartition(":")
    function = getattr(import_own(module, f"wrap {wrap}"), name, None) if module else None
    if not callable(function):
        raise UnplayableError(f"wrap {wrap}: there is no such function; name it as module:function")
    wrapped = function(environment)
    if not isinstance(wrapped, gymnasium.Env):
        raise UnplayableError(f"wrap {wrap} made {type(wrapped).__name__} of {environment}: it must be a gymnasium.Env")
    return wrapped
