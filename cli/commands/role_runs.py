"""`daedalus train` and `daedalus resume` for games whose roles have different spaces: a run for each role."""

import argparse
import shlex
import sys
from collections.abc import Mapping
from contextlib import ExitStack, suppress
from dataclasses import dataclass, replace
from pathlib import Path

from daedalus.cli.commands.train import (
    left_report,
    machine_options,
    report,
    resume_choice,
    show,
    stopped_text,
    stopping_event,
)
from daedalus.cli.screen import Screen
from daedalus.launch.child_output import ChildOutput
from daedalus.launch.environment_check import EnvironmentProblemError
from daedalus.launch.local_run import LocalRun, RunFailedError, RunStoppedError, UnsavedError
from daedalus.launch.local_training import evaluate_run
from daedalus.launch.logs import print_error, say
from daedalus.launch.process_lifecycle import NOT_REACHED, REACHED, status_at_start
from daedalus.launch.resumed_run import locked_to_resume, resumed_run, status_of
from daedalus.launch.role_training import RoleRun, RoleTraining, check_roles, seats_of
from daedalus.launch.run_choice import NewRun, create_run
from daedalus.learner.run import run_directory
from daedalus.learner.run.resuming import FinishedRun
from daedalus.learner.run.run_lock import RunInUseError
from daedalus.learner.run.settings import SettingsError
from daedalus.policy.saving.saved_policy import checkpoints
from daedalus.policy.user_modules import UserModuleError, allow_settings
from daedalus.protocol.spec import RunSpec

_FAULTS = (EnvironmentProblemError, RunInUseError, SettingsError, UserModuleError)


@dataclass(frozen=True, slots=True, kw_only=True)
class _Roles:
    """The runs of a game, in one directory."""

    parent: Path
    runs: Mapping[str, LocalRun]  # by role: to train, or trained and to evaluate
    over: Mapping[str, LocalRun]  # with nothing left to do
    missed: bool = False  # whether one of those used up its budget before its target

    @property
    def specs(self) -> dict[str, RunSpec]:
        """The settings of all runs."""
        return {role: run.spec for role, run in {**self.runs, **self.over}.items()}

    @property
    def resume_command(self) -> str:
        """The command that continues the runs."""
        modules = {name: value for spec in self.specs.values() for name, value in spec.user_modules.items()}
        return shlex.join(["daedalus", "resume", str(self.parent), *allow_settings(modules)])


def train_roles(
    parsed: argparse.Namespace, new: NewRun, agents: Mapping[str, tuple[str, ...]], screen: Screen, started: float
) -> int:
    """Create and train a run for each role, with its agents; return the exit status of `daedalus train`."""
    with ExitStack() as stack:
        try:
            _refuse_options(parsed)
            roles = _created(parsed, new, agents, started, stack)
        except _FAULTS as error:
            print_error("train", error)
            return _status(error)
        return _run(roles, parsed, screen, "daedalus train")


def resume_roles(parsed: argparse.Namespace, directories: Mapping[str, Path], screen: Screen, started: float) -> int:
    """Continue the runs of all roles; return the exit status of `daedalus resume`."""
    with ExitStack() as stack:
        try:
            _refuse_options(parsed)
            roles = _resumed(parsed, directories, started, stack)
        except _FAULTS as error:
            print_error("resume", error)
            return _status(error)
        if not roles.runs:
            say(f"nothing to do: the runs of {', '.join(roles.over)} are over")
            return NOT_REACHED if roles.missed else REACHED
        return _run(roles, parsed, screen, "daedalus resume")


def _status(error: Exception) -> int:
    return 1 if isinstance(error, EnvironmentProblemError | RunInUseError) else status_at_start(error)


def _refuse_options(parsed: argparse.Namespace) -> None:
    """Raise SettingsError for what only one run can have."""
    one = {"--watch": parsed.watch, "--tls": parsed.tls, "--inference": parsed.inference != "local"}
    one |= {f"--{name}": getattr(parsed, name.replace("-", "_"), None) for name in ("init-from", "demonstrations")}
    for option, value in one.items():
        if value:
            raise SettingsError(
                f"{option} is for one run, and the roles of this game need a run each: start the learners, a router "
                "and the actors by hand (the guide `Several agents`, Roles)"
            )


def _created(
    parsed: argparse.Namespace,
    new: NewRun,
    agents: Mapping[str, tuple[str, ...]],
    started: float,
    stack: ExitStack,
) -> _Roles:
    changes: dict[str, list[str]] = {role: [] for role in agents}
    for role, assignment in parsed.set_role:
        if role not in changes:
            raise SettingsError(f"--set-role {role}: the roles of this game are {', '.join(agents)}")
        changes[role].append(assignment)
    parent = new.directory or run_directory.make_numbered(new.choice.directory(new.choice.spec()))
    runs: dict[str, LocalRun] = {}
    with run_directory.made(parent):
        try:
            for role, own in agents.items():
                choice = replace(new.choice, assignments=(*new.choice.assignments, *changes[role]))
                given = choice.spec()
                if given.environment.agents or given.league.sides:
                    raise SettingsError(
                        "environment.agents and league.sides follow from the roles of this game: leave them out"
                    )
                # All on one side: they have no opponent in their own run.
                fixed = [f"environment.agents={list(own)}", *([f"league.sides=[{list(own)}]"] if len(own) > 1 else [])]
                choice = replace(choice, assignments=(*choice.assignments, *fixed))
                directory = run_directory.role_directory(parent, role)
                own_run = replace(new, choice=choice, directory=directory)
                lock, run = create_run(own_run, started=started, fork=True)
                stack.enter_context(lock)
                runs[role] = replace(run, **machine_options(parsed, lock.directory))
            check_roles({role: run.spec for role, run in runs.items()})
        except BaseException:
            for run in runs.values():
                run_directory.remove_failed(run.directory)
            raise
    return _Roles(parent=parent, runs=runs, over={})


def _resumed(parsed: argparse.Namespace, directories: Mapping[str, Path], started: float, stack: ExitStack) -> _Roles:
    runs: dict[str, LocalRun] = {}
    over: dict[str, LocalRun] = {}
    missed = False
    for role, directory in directories.items():
        choice = resume_choice(parsed, directory)
        spec = choice.spec()
        lock, init_from = locked_to_resume(directory)
        stack.enter_context(lock)
        run = resumed_run(choice, spec, lock, init_from, started=started, fork=True)
        if isinstance(run, FinishedRun):
            missed = missed or bool(status_of(run))
            over[role] = LocalRun(directory=lock.directory, spec=spec, started=started)
        else:
            runs[role] = replace(run, **machine_options(parsed, lock.directory))
    roles = _Roles(parent=parsed.directory, runs=runs, over=over, missed=missed)
    check_roles(roles.specs)
    return roles


def _run(roles: _Roles, parsed: argparse.Namespace, screen: Screen, command: str) -> int:
    """Train and evaluate the runs, print the results, and return the exit status."""
    stopping = stopping_event(exits_with_parent=parsed.exit_with_parent)
    seats = seats_of(roles.specs)

    def with_output(role: str, run: LocalRun) -> RoleRun:
        path = run.directory / run_directory.OUTPUT
        named = ChildOutput(
            path, lambda line: screen.out(f"{role}: {line}"), lambda line: screen.err(f"{role}: {line}")
        )
        output = stack.enter_context(named)
        return RoleRun(role=role, seats=seats[role], run=run, output=output)

    statuses: dict[str, int] = {}
    try:
        with ExitStack() as stack:
            output = stack.enter_context(ChildOutput(roles.parent / run_directory.OUTPUT, screen.out, screen.err))
            every = [with_output(role, run) for role, run in roles.runs.items()]
            learning = [role for role in every if role.run.trained is None]
            over = [role for role in every if role.run.trained is not None]
            over += [with_output(role, run) for role, run in roles.over.items()]
            if learning:
                statuses = RoleTraining(learning, over, output, parsed.listen).run(stopping)
            for role in every:
                summary = evaluate_run(role.run, stopping, role.output, role.output.unlimited_pipes)
                text = "\n".join(filter(None, [report(role.run, summary), left_report(role.run.directory)]))
                show("\n".join(f"{role.role}: {line}" for line in text.splitlines()), command)
        trained = [run.trained for run in roles.runs.values() if run.trained is not None]
        return max([*statuses.values(), *trained, NOT_REACHED if roles.missed else REACHED])
    except RunStoppedError as error:
        show(stopped_text(error, roles.resume_command), command)
        return 1
    except RunFailedError as error:
        if str(error):
            say(f"{command}: {str(error).rstrip()}", sys.stderr)
        kept = any(checkpoints(run.directory) for run in roles.runs.values()) or isinstance(error, UnsavedError)
        if kept:
            say(f"when that is corrected, continue with: {roles.resume_command}", sys.stderr)
        elif command == "daedalus train":
            for run in roles.runs.values():
                run_directory.remove_failed(run.directory)
            with suppress(OSError):  # it has other files
                roles.parent.rmdir()
        return error.status
