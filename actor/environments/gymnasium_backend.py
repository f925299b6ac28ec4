"""Backend `gymnasium`: its environments and those that users register with it. Also backend `fast`, for CarRacing."""

import importlib
import inspect
import sys
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import Any, cast

import gymnasium
from gymnasium.envs.registration import EnvSpec, load_env_creator
from gymnasium.vector import AutoresetMode
from gymnasium.vector.utils import CloudpickleWrapper
from gymnasium.wrappers import TimeLimit

from daedalus.actor.environments import atari
from daedalus.actor.environments.environment_errors import (
    EnvironmentSetupError,
    creation_errors,
    import_extra,
    not_registered,
    of_module,
    unknown_to_gymnasium,
)
from daedalus.actor.environments.environment_packages import REGISTERING
from daedalus.actor.environments.environment_processes import EnvironmentProcesses
from daedalus.actor.environments.given_environment import Maker, given_environment
from daedalus.actor.environments.gymnasium_environments import EnvironmentsInTurn, GymnasiumEnvironments
from daedalus.actor.environments.info import has_choices
from daedalus.actor.environments.parameters import WithParameters
from daedalus.actor.environments.rendering import CountedSteps, render_without_display
from daedalus.actor.environments.transforms import LegalRepeats
from daedalus.actor.environments.wrappers import Camera, MaskInInfo, OneEpisode, RepeatedSteps, Shutter
from daedalus.policy.user_code import first_line
from daedalus.policy.user_modules import NO_MODULES, UserModuleError, UserModules, object_of
from daedalus.protocol.spec import FROM_PYTHON, EnvironmentSpec

_OLD_ATARI = ("-v0", "-v4")  # versions of Atari's games under names without ALE/, such as PongNoFrameskip-v4
# Arguments of the constructor that change an Atari game, by the same names on all backends. ALE's own has no modes.
_ATARI_GAME_KWARGS = (
    *("repeat_action_probability", "full_action_space", "mode", "difficulty"),
    *("noop_max", "use_fire_reset"),
)
_LIMIT = "max_episode_steps"
_CAR_RACING = "gymnasium.envs.box2d.car_racing:CarRacing"


@dataclass(frozen=True, slots=True, kw_only=True)
class EnvironmentFactory:
    """A picklable function that creates one environment, here or in a process of its own."""

    spec: EnvironmentSpec
    modules: UserModules = NO_MODULES
    render_mode: str | None = None
    camera: Camera | None = None
    one_episode: bool = False
    registered: EnvSpec | None = None  # if the process that makes the environment may not have its registration

    def __call__(self) -> gymnasium.Env:
        """Return a new environment. Raises whatever the environment raises."""
        spec, registered = self.spec, self.registered or registration(self.spec.id, self.modules)
        kwargs = _kwargs(spec)
        if _LIMIT in spec.constructor_kwargs and _takes_limit(registered):
            registered = replace(registered, kwargs={**registered.kwargs, _LIMIT: spec.constructor_kwargs[_LIMIT]})
            kwargs[_LIMIT] = spec.max_episode_steps
        of_atari = atari.take_arguments(kwargs) if registered.namespace == "ALE" else {}
        if self.render_mode is not None:
            kwargs["render_mode"] = self.render_mode
        if kwargs.get("render_mode") == "rgb_array":  # also from environment.kwargs
            render_without_display()
        late_rendered = registered.entry_point == _CAR_RACING and spec.wrap is None
        if late_rendered:
            registered = _late_rendered(registered, spec.backend)
        environment = self._make(registered, kwargs)
        _check_limit(environment, spec)
        if "minigrid.minigrid_env" in sys.modules:
            from daedalus.actor.environments import minigrid_views  # needs an optional package

            minigrid_views.speed_up(environment)
        environment = self._in_wrappers(atari.wrapped(environment, of_atari))
        if late_rendered:
            from daedalus.actor.environments.car_racing import RenderObservation  # needs optional packages

            environment = RenderObservation(environment)
        return OneEpisode(environment) if self.one_episode else environment

    def _make(self, registered: EnvSpec, kwargs: dict[str, Any]) -> gymnasium.Env:
        name = self.spec.id
        try:
            # The checker costs a tenth of the speed, and warns only authors.
            return gymnasium.make(registered, disable_env_checker=True, **kwargs)
        except TypeError as error:
            if "must inherit from the gymnasium.Env" in str(error):
                raise EnvironmentSetupError(
                    f"environment {name} is no gymnasium.Env: if it is a game of PettingZoo's with several agents, "
                    "add --set environment.backend=pettingzoo"
                ) from None
            if self.render_mode is None or "keyword argument 'render_mode'" not in str(error):
                raise
            reason = "its constructor has no argument render_mode"
            raise EnvironmentSetupError(
                f"environment {name} cannot render {self.render_mode} images: {reason}"
            ) from None

    def _in_wrappers(self, environment: gymnasium.Env) -> gymnasium.Env:
        """Return an environment in the wrappers of the specification."""
        spec, below = self.spec, None
        if spec.wrap is not None:
            if self.camera is not None:
                environment = below = CountedSteps(environment)
            environment = _wrapped(environment, spec.wrap, self.modules)
        if spec.parameters:
            environment = WithParameters(environment, spec.id, spec.parameters)
        if environment.has_wrapper_attr("action_masks"):
            environment = MaskInInfo(environment)
        masks = {}
        if spec.action_repeat > 1 and has_choices(environment.action_space, spec):
            masks["is_legal"] = LegalRepeats(spec, environment.observation_space, environment.action_space)
        if spec.action_repeat == 1 and spec.no_reward_limit is None and self.camera is None:
            return environment
        return RepeatedSteps(
            environment,
            spec.id,
            repeat=spec.action_repeat,
            no_reward_limit=spec.no_reward_limit,
            camera=self.camera,
            below=below,
            **masks,
        )

    def uses_vector_entry_point(self, registered: EnvSpec) -> bool:
        """Return whether the environment's own vector entry point can be used: it has one, and needs no wrapper."""
        # ALE's vector entry point is another environment: it stacks, resizes and clips by itself (see backend=ale).
        if registered.vector_entry_point is None or registered.namespace == "ALE":
            return False
        spec = self.spec
        wrappers = (spec.no_reward_limit, spec.wrap, self.render_mode, self.camera, spec.parameters or None)
        return spec.action_repeat == 1 and not spec.processes and all(wrapper is None for wrapper in wrappers)


def make_gymnasium(
    spec: EnvironmentSpec,
    count: int,
    *,
    modules: UserModules = NO_MODULES,
    render_mode: str | None = None,
    camera: Camera | None = None,
    one_episode: bool = False,
) -> GymnasiumEnvironments:
    """Return `count` environments: by their own vector entry point if possible, else stepped in turn or in processes.

    See make_environments for the arguments. Raises EnvironmentSetupError.
    """
    shutter = None if camera is None else Shutter(camera)
    factory = EnvironmentFactory(
        spec=spec, modules=modules, render_mode=render_mode, camera=shutter, one_episode=one_episode
    )
    with creation_errors(spec.id):
        _check_backend(spec, modules)
        environment = _make_vector(factory, count)
    if environment.metadata.get("autoreset_mode") is not AutoresetMode.NEXT_STEP:
        environment.close()
        raise EnvironmentSetupError(
            f"environment {spec.id} has autoreset mode {environment.metadata.get('autoreset_mode')}: "
            "its vector entry point must use gymnasium's AutoresetMode.NEXT_STEP"
        )
    try:
        choices = has_choices(environment.single_action_space, spec)
        environments = GymnasiumEnvironments(environment, spec.id, spec.leave_out, has_choices=choices)
    except EnvironmentSetupError:
        environment.close()
        raise
    if shutter is not None:
        shutter.is_open = True  # after the reset that shows whether there are masks
    return environments


def make_single(spec: EnvironmentSpec, modules: UserModules) -> gymnasium.Env | None:
    """Return one environment as training plays it, or None if it is registered with a vector entry point only.

    Raises EnvironmentSetupError.
    """
    with creation_errors(spec.id):
        _check_backend(spec, modules)
        single = registration(spec.id, modules).entry_point is not None
        return EnvironmentFactory(spec=spec, modules=modules)() if single else None


def uses_vector_entry_point(spec: EnvironmentSpec, modules: UserModules) -> bool:
    """Return whether training plays the environment by a vector entry point of its own."""
    if spec.backend != "gymnasium":
        return False
    return EnvironmentFactory(spec=spec, modules=modules).uses_vector_entry_point(registration(spec.id, modules))


def _check_backend(spec: EnvironmentSpec, modules: UserModules) -> None:
    if spec.backend == "fast" and registration(spec.id, modules).entry_point != _CAR_RACING:
        raise EnvironmentSetupError(
            f"environment.backend=fast supports CarRacing-v3 only, not {spec.id}: "
            "use --set environment.backend=gymnasium"
        )


def registration(environment_id: str, modules: UserModules) -> EnvSpec:
    """Return gymnasium's registration of `[module:]id`, which importing the module registers, or that of an object.

    `module:Class` and `module:function` are such objects, and what a Python program has given to this process.
    """
    if environment_id.startswith(FROM_PYTHON):
        return given_environment(environment_id)
    name, own = environment_id.rpartition(":")[2], None
    if name != environment_id:
        try:
            own = modules.load("environment.id", environment_id)
        except UserModuleError as error:
            raise of_module(error) from error
    else:
        for beginning, (module, extra) in REGISTERING.items():
            if name.startswith(beginning):
                gymnasium.register_envs(import_extra(module, extra, f"environment {name}"))
        if name.endswith(_OLD_ATARI) and name not in gymnasium.registry:
            with suppress(ImportError):
                gymnasium.register_envs(importlib.import_module("ale_py"))
    try:
        return gymnasium.spec(name)
    except gymnasium.error.Error:
        entry: Any = None if own is None else object_of(own, name)
        if callable(entry):
            return EnvSpec(id=name, entry_point=cast(Maker, entry))
        raise (unknown_to_gymnasium(name) if own is None else not_registered(name, own)) from None


def as_on_gymnasium(spec: EnvironmentSpec) -> EnvironmentSpec:
    """Return the specification for an evaluation on gymnasium's implementation of the environment.

    Atari games of the other backends have another name there, repeat actions unless told not to, and begin always in
    the same way. Of their `kwargs` those are kept that change the game itself.
    """
    if spec.is_game:  # gymnasium has none
        return spec.as_evaluated()
    evaluated = spec.as_evaluated("gymnasium")
    if spec.backend == "gymnasium":
        return evaluated
    atari_id = f"ALE/{spec.id.removeprefix('ALE/').removesuffix('-v5')}-v5"
    with suppress(ImportError):
        gymnasium.register_envs(importlib.import_module("ale_py"))
    if atari_id not in gymnasium.registry:
        return evaluated
    same_game = {name: value for name, value in evaluated.kwargs.items() if name in _ATARI_GAME_KWARGS}
    defaults = {"frameskip": 1, "repeat_action_probability": 0.0, **atari.DEFAULTS}  # of the other backends
    kwargs = {**defaults, "maxpool": spec.action_repeat > 1, **same_game}
    return evaluated.model_copy(update={"id": atari_id, "kwargs": kwargs})


def _late_rendered(registered: EnvSpec, backend: str) -> EnvSpec:
    """Return CarRacing's registration with a class that renders on demand: most of its time goes into unused frames."""
    from daedalus.actor.environments.car_racing import FastCarRacing, LateRenderedCarRacing

    return replace(registered, entry_point=FastCarRacing if backend == "fast" else LateRenderedCarRacing)


def _make_vector(factory: EnvironmentFactory, count: int) -> Any:
    spec, registered = factory.spec, registration(factory.spec.id, factory.modules)
    if spec.parameters and registered.entry_point is None:
        raise EnvironmentSetupError(
            f"environment {spec.id} has a vector entry point only, whose environments take no environment.parameters: "
            "register an entry point for one environment, too"
        )
    if factory.uses_vector_entry_point(registered):
        if not factory.one_episode:
            return gymnasium.make_vec(registered, count, "vector_entry_point", **_kwargs(spec))
        if registered.entry_point is None:  # its environments share a random generator, so more than one would not do
            return gymnasium.make_vec(registered, 1, "vector_entry_point", **_kwargs(spec))
    if spec.processes and spec.backend == "gymnasium" and factory.camera is None:
        if spec.is_from_python:
            raise EnvironmentSetupError(
                f"environment.processes is not for {spec.id}, which no module has: move it to a module, or start more "
                "actors with one environment each (collection.envs_per_actor=1)"
            )
        if ":" not in spec.id:  # no module registers it there: the program itself may have done it here
            factory = replace(factory, registered=registered)
        return _in_processes(factory, count)
    return EnvironmentsInTurn(spec.id, [factory] * count, left_out=spec.leave_out)


def _in_processes(factory: EnvironmentFactory, count: int) -> EnvironmentProcesses:
    """Return environments in processes, which do not import the main module of this program."""
    spec = factory.spec
    try:
        CloudpickleWrapper(factory).__getstate__()
    except Exception as error:  # of whatever the program has registered
        reason = first_line(error)
    else:
        try:
            return EnvironmentProcesses(spec.id, [factory] * count, left_out=spec.leave_out)
        except AttributeError as error:
            if "__main__" not in str(error):
                raise
            reason = first_line(error)  # such as a space of a class of its own, in the answer of a process
    raise EnvironmentSetupError(
        f"environment {spec.id} is of this program itself, and does not work in processes ({reason}): move it to a "
        f"module and name it MODULE:{spec.id}, or use environment.processes=false"
    )


def _kwargs(spec: EnvironmentSpec) -> dict[str, Any]:
    limit = {} if spec.max_episode_steps is None else {_LIMIT: spec.max_episode_steps}
    return {**spec.constructor_kwargs, **limit}


def _takes_limit(registered: EnvSpec) -> bool:
    """Return whether the constructor has an argument max_episode_steps, which gymnasium.make keeps for itself."""
    entry = registered.entry_point
    with suppress(TypeError, ValueError):  # of a constructor in C
        return _LIMIT in inspect.signature(load_env_creator(entry) if isinstance(entry, str) else entry).parameters  # pyright: ignore[reportArgumentType]
    return False


def _check_limit(environment: gymnasium.Env, spec: EnvironmentSpec) -> None:
    """Raise EnvironmentSetupError if a limit of the environment's own makes that of the specification ineffective."""
    wanted = spec.max_episode_steps
    while wanted is not None and isinstance(environment, gymnasium.Wrapper):
        if isinstance(environment, TimeLimit) and environment._max_episode_steps < wanted:
            raise EnvironmentSetupError(
                f"environment.max_episode_steps={wanted} has no effect: what {spec.id} makes truncates its episodes "
                f"after {environment._max_episode_steps} steps itself (TimeLimit); change it there"
            )
        environment = environment.env


def _wrapped(environment: gymnasium.Env, wrap: str, modules: UserModules) -> gymnasium.Env:
    """Return the environment in the user's wrapper `module:function`."""
    try:
        function = modules.attribute("environment.wrap", wrap)
    except UserModuleError as error:
        raise of_module(error) from error
    if not callable(function):
        raise EnvironmentSetupError(f"environment.wrap={wrap} is not a function: name it as module:function")
    wrapped = function(environment)
    if not isinstance(wrapped, gymnasium.Env):
        raise EnvironmentSetupError(
            f"environment.wrap={wrap} returned {type(wrapped).__name__} for {environment}: "
            "it must return a gymnasium.Env"
        )
    return wrapped
