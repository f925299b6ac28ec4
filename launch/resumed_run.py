"""What `daedalus resume` and `daedalus.resume` continue: the settings of a run with changes, and its environment."""

from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from daedalus.launch.environment_check import checked_spaces
from daedalus.launch.local_run import LocalRun
from daedalus.launch.process_lifecycle import NOT_REACHED, REACHED
from daedalus.launch.run_choice import RunChoice, check_learner_installed, warn_of_unread, with_record
from daedalus.learner.run import run_directory
from daedalus.learner.run.resuming import (
    FinishedRun,
    finished_run,
    initial_to_resume,
    only_at_the_start,
    other_spaces,
    with_changes,
)
from daedalus.learner.run.run_lock import RunLock
from daedalus.learner.run.settings import SettingsError
from daedalus.policy.saving.saved_policy import NoPolicyError, checkpoints, find_policy
from daedalus.policy.saving.sealed import DamagedError
from daedalus.policy.user_code import Surroundings
from daedalus.policy.user_modules import UserModules
from daedalus.protocol.spec import RunSpec


@dataclass(frozen=True, slots=True, kw_only=True)
class ResumeChoice:
    """The run to continue and what a user changes, as the user chose them."""

    directory: Path
    env_steps: int | None = None  # new budget; None: that of the run
    assignments: Sequence[str] = ()  # changed settings, each as SECTION.KEY=VALUE
    settings: Mapping[str, Any] = field(default_factory=dict)  # changed settings, by SECTION.KEY
    allowed_modules: frozenset[str] = frozenset()
    reset_statistics: bool = False

    def spec(self, *, from_python: bool = False) -> RunSpec:
        """Return the specification of the run with the changes. Raises SettingsError, UserModuleError.

        `from_python`: the environment is passed again as an object.
        """
        check_learner_installed()
        spec = run_directory.read_config(self.directory)
        modules = UserModules(self.allowed_modules, str(self.directory / run_directory.CONFIG))
        modules.check(spec.user_modules)
        if spec.environment.is_from_python and not from_python:
            raise SettingsError(
                f"the environment of this run, {spec.environment.id}, is an object of the Python program that started "
                f"it, and no module has it: continue in Python, with daedalus.resume({str(self.directory)!r}, env=...)"
            )
        RunChoice(env_steps=self.env_steps, assignments=self.assignments, settings=self.settings).refuse_two_values()
        settings = dict(self.settings)
        if self.env_steps is not None:
            settings["training.env_steps"] = self.env_steps
        with Surroundings():  # which an algorithm of the user may change when it is imported
            changed = with_record(with_changes(spec, self.assignments, self.directory, settings), modules)
        chosen = RunChoice(assignments=self.assignments, settings=settings).assigned
        shown = (self.directory / run_directory.DEMONSTRATIONS).is_dir()
        warn_of_unread(chosen, changed, only_at_the_start(self.directory), demonstrations=shown)
        return changed


def locked_to_resume(directory: Path) -> tuple[RunLock, Path | None]:
    """Return the lock of a run, and the run whose weights it still has to begin with, or None.

    Raises RunInUseError, SettingsError.
    """
    initial = initial_to_resume(directory)
    return RunLock(directory), initial


def status_of(finished: FinishedRun) -> int:
    """Return the exit status of a run that has nothing left to train."""
    return NOT_REACHED if finished.missed else REACHED


def resumed_run(
    choice: ResumeChoice,
    spec: RunSpec,
    lock: RunLock,
    init_from: Path | None,
    *,
    started: float,
    fork: bool = False,
) -> LocalRun | FinishedRun:
    """Check the environment of a run that is locked, write its settings, and return the run, or that it has finished.

    `fork`: see quick_check. Raises EnvironmentProblemError, SettingsError.
    """
    finished = finished_run(choice.directory, spec)
    if finished is not None and not finished.to_evaluate:
        return finished
    environment = spec.environment
    # Modules may be of another folder, and objects others than before.
    is_known = checkpoints(choice.directory) and not (environment.user_modules or environment.is_from_python)
    spaces = None if is_known else checked_spaces(spec, fork=fork)
    if spaces is not None:
        with suppress(NoPolicyError, DamagedError):  # the learner reports a damaged checkpoint
            if difference := other_spaces(find_policy(choice.directory, newest=True), environment, spaces):
                raise SettingsError(f"the environment is another than that of the run: {difference}")
    # A learner may refuse the settings; a run that is only evaluated has none.
    write = run_directory.change_config if finished is None else run_directory.write_config
    write(choice.directory, spec)
    return LocalRun(
        directory=lock.directory,
        spec=spec,
        started=started,
        lock=lock.inheritable,
        spaces=spaces,
        init_from=init_from,
        resume=True,
        reset_statistics=choice.reset_statistics,
        trained=None if finished is None else status_of(finished),
    )
