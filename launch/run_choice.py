"""What a user chose to run, and the settings, spaces and directory that a new run gets from it."""

import copy
import importlib.util
import logging
from collections.abc import Mapping, Sequence
from collections.abc import Set as AbstractSet
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from daedalus.launch.environment_check import checked_defaults, checked_spaces, transformed_spaces
from daedalus.launch.local_run import LocalRun
from daedalus.learner.run import run_directory
from daedalus.learner.run.default_settings import default_settings
from daedalus.learner.run.resuming import check_initial
from daedalus.learner.run.run_lock import RunLock
from daedalus.learner.run.settings import (
    SettingsError,
    assign,
    changed_settings,
    choose_algorithm,
    flat_settings,
    override,
    preset_names,
    read_preset,
    run_spec,
    unmeasured_target,
    unread_settings,
)
from daedalus.policy.user_code import Surroundings
from daedalus.policy.user_modules import UserModules
from daedalus.protocol.algorithms import ALGORITHMS
from daedalus.protocol.spaces import Spaces
from daedalus.protocol.spec import RunSpec

_logger = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True, kw_only=True)
class RunChoice:
    """A preset or an environment, and settings, as a user chose them; None: not chosen."""

    preset: str | None = None
    env: str | None = None
    algorithm: str | None = None
    seed: int | None = None
    env_steps: int | None = None
    actors: int | None = None
    wrap: str | None = None
    is_instance: bool = False  # whether `env` is one environment, which exists already
    assignments: Sequence[str] = ()  # further settings, each as SECTION.KEY=VALUE
    settings: Mapping[str, Any] = field(default_factory=dict)  # further settings, by SECTION.KEY

    @property
    def is_named(self) -> bool:
        """Whether there is a preset or an environment."""
        return self.preset is not None or self.env is not None

    def spec(self, defaults: dict[str, Any] | None = None) -> RunSpec:
        """Return the specification. Raises SettingsError.

        `defaults` are the settings that an environment begins with; None: those for spaces that are not known.
        """
        if self.preset is not None and self.env is not None:
            raise SettingsError(f"leave out one of {self.preset} and --env {self.env}")
        if self.preset is None and self.env is None:
            raise SettingsError(f"name a preset ({', '.join(preset_names())}) or an environment with --env ID")
        if self.preset is not None:
            return run_spec(self._applied(read_preset(self.preset)))
        base = default_settings(None) if defaults is None else copy.deepcopy(defaults)
        with_memory = base.pop("with_memory", {})
        base.setdefault("environment", {})["id"] = self.env
        settings = self._applied(copy.deepcopy(base))
        if settings.get("policy", {}).get("memory", "none") != "none":
            for section, values in with_memory.items():
                base.setdefault(section, {}).update(values)
            if settings.get("collection", {}).get("upload") == "gradients":
                base["training"].pop("curiosity", None)  # which needs rollouts
        if self.is_instance:
            _fit_one_environment(base, settings["training"]["algorithm"])
        settings = self._applied(base)
        spec = run_spec(settings)
        if self.is_instance and (spec.collection.actors, spec.collection.envs_per_actor) != (1, 1):
            raise SettingsError(
                f"env is one instance, and {spec.collection.actors} actors with {spec.collection.envs_per_actor} "
                "environments each need more: leave out actors and collection.envs_per_actor, or pass its class, or a "
                "function that makes it"
            )
        return spec

    @property
    def assigned(self) -> set[str]:
        """The settings that were chosen by name."""
        return {*(assignment.partition("=")[0].strip() for assignment in self.assignments), *self.settings}

    def names(self) -> set[str]:
        """Return the settings that were chosen; of a file, those that differ from the defaults of this release."""
        chosen = self.assigned
        if self.preset is not None and self.preset not in preset_names():
            chosen.update(changed_settings(flat_settings(read_preset(self.preset))))
        return chosen

    def directory(self, spec: RunSpec) -> Path:
        """Return the default run directory, named after the preset or file, or after the environment.

        A repeated config.toml of another run has no name of its own.
        """
        named = self.preset is not None and Path(self.preset).name != run_directory.CONFIG
        return run_directory.default_directory(Path(self.preset or "").stem if named else spec.environment.id, spec)

    def _applied(self, settings: dict[str, Any]) -> dict[str, Any]:
        """Return settings after the choices, which change them in place. Raises SettingsError."""
        changed = copy.deepcopy(settings)
        if self.algorithm is not None:
            changed.setdefault("training", {})["algorithm"] = self.algorithm
        self._change(changed)  # which may choose the algorithm, too
        algorithm = changed.get("training", {}).get("algorithm")
        replaced = choose_algorithm(settings, algorithm)
        if replaced and self.preset is not None and self.preset not in preset_names():
            _logger.warning(
                "%s replaces these settings of %s with those of its own defaults: %s; choose others with --set",
                algorithm,
                self.preset,
                ", ".join(replaced),
            )
        for path, value in self._options().items():
            assign(settings, path, value)
        self._change(settings)
        if self.env is not None and (chosen := settings["environment"].get("id")) != self.env:
            raise SettingsError(
                f"--env {self.env} and environment.id={chosen} are two environments: leave one of them out"
            )
        return settings

    def _options(self) -> dict[str, Any]:
        """Return the settings that have an option of their own, where it was given, by SECTION.KEY."""
        options = {
            "training.seed": self.seed,
            "training.env_steps": self.env_steps,
            "collection.actors": self.actors,
            "environment.wrap": self.wrap,
        }
        return {path: value for path, value in options.items() if value is not None}

    def refuse_two_values(self) -> None:
        """Raise SettingsError if an option and a further setting give one setting two values."""
        changed: dict[str, Any] = {}
        self._change(changed)
        for path, value in {**self._options(), "training.algorithm": self.algorithm}.items():
            section, key = path.split(".")
            other = changed.get(section, {}).get(key, "none")  # an unset one is not there
            if value is not None and path in self.assigned and other != value:
                option = "--" + key.replace("_", "-")
                raise SettingsError(f"{option} {value} and {path}={other} are two values: leave one of them out")

    def _change(self, settings: dict[str, Any]) -> None:
        """Apply the further settings, in place."""
        override(settings, self.assignments)
        for path, value in self.settings.items():
            try:
                assign(settings, path, value)
            except SettingsError as error:
                raise SettingsError(f"settings {path!r}: {error}") from None


def _fit_one_environment(settings: dict[str, Any], algorithm: str) -> None:
    """Change default settings, in place, so that the batches of one environment are as large as those of several."""
    collection, record = settings["collection"], ALGORITHMS.get(algorithm)
    rollouts = (record and record.batch_rollouts) or collection["actors"]
    if record is None or not (record.synchronous or record.replay):
        settings["training"]["batch_rollouts"] = rollouts * collection["envs_per_actor"]
    collection |= {"actors": 1, "envs_per_actor": 1}


@dataclass(frozen=True, slots=True, kw_only=True)
class NewRun:
    """A run to start, as a user chose it."""

    choice: RunChoice
    directory: Path | None = None  # None: a new folder in runs/
    init_from: Path | None = None  # another run, or one of its checkpoints, whose weights to begin with
    other_spaces: bool = False  # accept `init_from` of other spaces
    demonstrations: str | None = None  # dataset to learn from, too

    def create(self, spec: RunSpec, directory: Path, spaces: Spaces | None = None) -> tuple[RunLock, RunSpec]:
        """Create the run directory, with its demonstrations. A default directory that is there gets a number.

        `spaces` are those of the run, if they are known. Return its lock, and the specification with the package of the
        environment. Raises SettingsError.
        """
        from daedalus.actor.environments.environment_packages import with_package  # only a new run needs it

        spec = spec.model_copy(update={"environment": with_package(spec.environment)})
        lock = run_directory.create_locked(
            directory,
            spec,
            numbered=self.directory is None,
            init_from=self.init_from,
            other_spaces=self.other_spaces,
        )
        if self.demonstrations is not None:
            from daedalus.launch.dataset_import import write_demonstrations  # what other runs need not import

            try:
                write_demonstrations(self.demonstrations, spec, spaces, lock.directory)
            except BaseException:
                run_directory.remove_failed(lock.directory)
                lock.close()
                raise
        return lock, spec


_LEARNER_PACKAGES = ("torch", "onnx", "tensorboard")


def check_learner_installed() -> None:
    """Raise SettingsError if this installation has no learner."""
    if absent := [name for name in _LEARNER_PACKAGES if importlib.util.find_spec(name) is None]:
        raise SettingsError(
            f"this is the installation of an actor, and a learner needs {' and '.join(absent)}: "
            'pip install "daedalus-rl[learner]"; for once: uvx --from "daedalus-rl[learner]" daedalus ...'
        )


def create_run(new: NewRun, *, started: float, fork: bool = False) -> tuple[RunLock, LocalRun]:
    """Check the environment of a new run, and create its directory.

    `fork`: see quick_check. Return the lock of the directory, and the run; without spaces where the check of the
    environment takes long. Raises SettingsError, EnvironmentProblemError or RunInUseError.
    """
    check_learner_installed()
    if new.directory is not None:
        run_directory.check_free(new.directory)  # before the environment is made
    check_initial(new.init_from, other_spaces=new.other_spaces)
    with Surroundings():  # which an algorithm of the user may change when it is imported
        spec, spaces = _prepared(new, fork)
    lock, spec = new.create(spec, new.directory or new.choice.directory(spec), spaces)
    return lock, LocalRun(
        directory=lock.directory,
        spec=spec,
        started=started,
        lock=lock.inheritable,
        spaces=spaces,
        init_from=new.init_from,
    )


def _prepared(new: NewRun, fork: bool) -> tuple[RunSpec, Spaces | None]:
    choice, spec = new.choice, new.choice.spec()
    if choice.env is None:
        spaces = checked_spaces(spec, fork=fork)
    else:
        spaces, defaults = checked_defaults(choice.spec, fork=fork)
        chosen = choice.spec(defaults)
        spaces, spec = transformed_spaces(chosen, spec, spaces, fork=fork), chosen
    if problem := unmeasured_target(spec):
        raise SettingsError(problem)
    # A file may be the config.toml of another run, with the default settings of its environment.
    unread = unread_settings(spec, spaces) & choice.assigned
    warn_of_unread(choice.names(), spec, unread, demonstrations=new.demonstrations is not None)
    return with_record(spec, UserModules.of(spec.user_modules)), spaces


_OF_DEMONSTRATIONS = {"training.cloning_updates", "training.cloning_weight"}


def warn_of_unread(
    chosen: set[str], spec: RunSpec, too: AbstractSet[str] = frozenset(), *, demonstrations: bool = True
) -> None:
    """Log which settings that a user chose have no effect in the run.

    Args:
      chosen: by the user.
      spec: of the run.
      too: further settings that nothing reads.
      demonstrations: whether the run has any.
    """
    too = too if demonstrations else too | _OF_DEMONSTRATIONS
    if unread := sorted(chosen & (unread_settings(spec) | too)):
        _logger.warning("no effect in this run (algorithm %s): %s", spec.training.algorithm, ", ".join(unread))


def with_record(spec: RunSpec, modules: UserModules) -> RunSpec:
    """Return the specification with the record of its algorithm, if that is the user's own.

    `modules` may be imported. Raises SettingsError.
    """
    if not spec.training.user_modules:
        return spec
    from daedalus.algorithms.own_algorithm import own_class  # torch, which other runs do not need here
    from daedalus.protocol.algorithms import AlgorithmError

    settings = spec.model_dump()
    try:
        settings["training"]["algorithm_record"] = own_class(spec.training.algorithm, modules).record.model_dump()
    except AlgorithmError as error:
        raise SettingsError(str(error)) from None
    return run_spec(settings)
