"""The settings and spaces of a new run, some of which its environment decides."""

import copy
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from daedalus.launch.environment_check import checked_defaults, checked_spaces, transformed_spaces
from daedalus.learner.run import run_directory
from daedalus.learner.run.default_settings import default_settings
from daedalus.learner.run.settings import (
    SettingsError,
    choose_algorithm,
    preset_names,
    read_preset,
    run_spec,
    unmeasured_target,
)
from daedalus.policy.user_code import Surroundings
from daedalus.policy.user_modules import UserModules, modules_of
from daedalus.protocol.spaces import Spaces
from daedalus.protocol.spec import RunSpec


def with_record(spec: RunSpec, modules: UserModules) -> RunSpec:
    """Return the specification with the record of its algorithm, if that is the user's own.

    `modules` may be imported. Raises SettingsError.
    """
    if not spec.training.user_modules:
        return spec
    from daedalus.algorithms.errors import AlgorithmError
    from daedalus.algorithms.own_algorithm import own_class  # torch, which other runs do not need here

    settings = spec.model_dump()
    try:
        settings["training"]["algorithm_record"] = own_class(spec.training.algorithm, modules).record.model_dump()
    except AlgorithmError as error:
        raise SettingsError(str(error)) from None
    return run_spec(settings)


MOST_PROCESSES = 256  # of a learner


def prepare(
    resolve: Callable[[dict[str, Any] | None], RunSpec], *, env: str | None, processes: int, fork: bool = False
) -> tuple[RunSpec, Spaces | None]:
    """Return the specification of a new run, and its spaces or None where the check of the environment takes long.

    Args:
      resolve: returns the specification; called with the settings that `env` begins with, or None before they are
        known. See settings_arguments.resolve.
      env: the environment, if the user named no preset.
      processes: of the learner.
      fork: see quick_check.

    Raises SettingsError, or EnvironmentProblemError.
    """
    with Surroundings():  # which an algorithm of the user may change when it is imported
        return _prepared(resolve, env, processes, fork=fork)


def _prepared(
    resolve: Callable[[dict[str, Any] | None], RunSpec], env: str | None, processes: int, *, fork: bool
) -> tuple[RunSpec, Spaces | None]:
    spec = resolve(None)
    check_processes(processes, spec)  # before the environment is made
    if env is None:
        spaces = checked_spaces(spec, fork=fork)
    else:
        spaces, defaults = checked_defaults(spec, fork=fork)
        chosen = resolve(defaults)
        spaces, spec = transformed_spaces(chosen, spec, spaces, fork=fork), chosen
        check_processes(processes, spec)
    if problem := unmeasured_target(spec):
        raise SettingsError(problem)
    return with_record(spec, UserModules(frozenset(modules_of(spec.user_modules)))), spaces


@dataclass(frozen=True, slots=True, kw_only=True)
class Choice:
    """A preset or an environment, and the most used settings, as a user chose them; None: not chosen."""

    preset: str | None
    env: str | None
    algorithm: str | None
    seed: int | None
    env_steps: int | None
    actors: int | None
    wrap: str | None

    def spec(self, change: Callable[[dict[str, Any]], None], defaults: dict[str, Any] | None = None) -> RunSpec:
        """Return the specification.

        Args:
          change: applies further settings, in place.
          defaults: settings that an environment begins with; None: those for spaces that are not known.

        Raises SettingsError.
        """
        if self.preset is not None and self.env is not None:
            raise SettingsError(f"leave out one of {self.preset} and --env {self.env}")
        if self.preset is None and self.env is None:
            raise SettingsError(f"name a preset ({', '.join(preset_names())}) or an environment with --env ID")
        if self.preset is not None:
            return run_spec(self._applied(read_preset(self.preset), change))
        base = default_settings(None) if defaults is None else copy.deepcopy(defaults)
        with_memory = base.pop("with_memory", {})
        base.setdefault("environment", {})["id"] = self.env
        settings = self._applied(copy.deepcopy(base), change)
        if settings.get("policy", {}).get("memory", "none") != "none":
            for section, values in with_memory.items():
                base.setdefault(section, {}).update(values)
            settings = self._applied(base, change)
        return run_spec(settings)

    def _applied(self, settings: dict[str, Any], change: Callable[[dict[str, Any]], None]) -> dict[str, Any]:
        """Return settings after the choices, which change them in place. Raises SettingsError."""
        changed = copy.deepcopy(settings)
        if self.algorithm is not None:
            changed.setdefault("training", {})["algorithm"] = self.algorithm
        change(changed)  # which may choose the algorithm, too
        choose_algorithm(settings, changed.get("training", {}).get("algorithm"))
        shortcuts = {
            ("training", "seed"): self.seed,
            ("training", "env_steps"): self.env_steps,
            ("collection", "actors"): self.actors,
            ("environment", "wrap"): self.wrap,
        }
        for (section, key), value in shortcuts.items():
            if value is not None:
                settings.setdefault(section, {})[key] = value
        change(settings)
        check_environment(self.env, settings)
        return settings


def check_environment(env: str | None, settings: dict[str, Any]) -> None:
    """Check that other settings name no other environment than `env`. Raises SettingsError."""
    if env is not None and (chosen := settings["environment"].get("id")) != env:
        raise SettingsError(f"--env {env} and environment.id={chosen} are two environments: leave one of them out")


def check_processes(number: int, spec: RunSpec) -> None:
    """Raise SettingsError if a learner of so many processes cannot learn what `spec` defines."""
    if number > 1 and spec.uploads_gradients:
        raise SettingsError(
            "collection.upload is gradients: the actors compute them, so that several processes of the learner would "
            "have nothing to do; leave out --processes, or set collection.upload=rollouts"
        )
    if not 1 <= number <= MOST_PROCESSES:
        raise SettingsError(f"the learner cannot have {number} processes: choose a number from 1 to {MOST_PROCESSES}")


def named_directory(preset: str | None, spec: RunSpec) -> Path:
    """Return the default run directory, named after the preset or file, or after the environment.

    A repeated config.toml of another run has no name of its own.
    """
    name = spec.environment.id if preset is None or Path(preset).name == run_directory.CONFIG else Path(preset).stem
    return run_directory.default_directory(name, spec)


@dataclass(frozen=True, slots=True, kw_only=True)
class ChosenRun:
    """Run of a learner, as its command line defines it."""

    spec: RunSpec
    directory: Path
    exists: bool  # whether the run directory was created before
    changed: list[str]  # settings of a run that exists, which the command line changes
    modules: UserModules  # that the learner may import
