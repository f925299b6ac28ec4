"""`daedalus train` and `daedalus resume`: train with a learner and actors on this machine, and evaluate the policy."""

import argparse
import importlib.util
import logging
import os
import shlex
import signal
import sys
import threading
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

from daedalus.cli.arguments import (
    add_allow_module,
    add_inference,
    add_insecure,
    add_logging,
    add_reset_statistics,
    add_tls,
    allowing,
    command_parser,
    log_options,
    whole_number,
)
from daedalus.cli.screen import Screen, TrainingDisplay
from daedalus.cli.settings_arguments import add_log, add_new_run, add_settings, new_run
from daedalus.launch.child_output import ChildOutput, inherited
from daedalus.launch.environment_check import EnvironmentProblemError, RolesError
from daedalus.launch.local_run import (
    LocalRun,
    RunEnd,
    RunFailedError,
    RunStoppedError,
    UnsavedError,
    resume_command,
)
from daedalus.launch.local_training import run_locally
from daedalus.launch.logs import print_error, say
from daedalus.launch.process_lifecycle import (
    UNWRITABLE,
    discard,
    exit_with_parent,
    process_started,
    status_at_start,
    stop_on_signals,
)
from daedalus.launch.resumed_run import ResumeChoice, locked_to_resume, resumed_run, status_of
from daedalus.launch.run_choice import create_run
from daedalus.launch.supervision import check_inference
from daedalus.learner.reporting.progress import is_terminal
from daedalus.learner.reporting.trackers.tracking import chosen_trackers
from daedalus.learner.run import run_directory
from daedalus.learner.run.resuming import FinishedRun
from daedalus.learner.run.run_files import RunDataError
from daedalus.learner.run.run_lock import RunInUseError, RunLock
from daedalus.learner.run.settings import SettingsError
from daedalus.policy.saving.saved_policy import checkpoints
from daedalus.policy.user_modules import ModuleNotAllowedError, UserModuleError
from daedalus.protocol.league import LeagueStatus
from daedalus.protocol.texts import printable, short_number, short_share
from daedalus.transport.credentials import SECURITY_ERRORS, credentials_to_listen

_logger = logging.getLogger(__name__)

_TRAIN = """\
Starts a learner and actors as processes of this machine and shows their progress. When the training episodes reach the
target, the policy of that moment plays 100 new sampled episodes (training.target_episodes). Training stops if they
confirm the target, or when the budget is used up. Then the best policy plays 100 episodes (evaluation.final_episodes).
To select it, the three best checkpoints by evaluations (evaluation.seconds), the three best by training episodes, and
the newest first play as many new episodes each, unless the newest was the best in training and nobody evaluated."""

_TRAIN_EXAMPLES = """\
examples:
  daedalus train cartpole
  daedalus train cartpole --algorithm a2c --actors 4 --seed 7
  daedalus train cartpole --algorithm n_step_q
  daedalus train --env Acrobot-v1 --env-steps 500000
  daedalus train --env my_module:MyEnv-v0        (my_module.py in this folder registers MyEnv-v0)
  daedalus train cartpole --init-from runs/cartpole-impala-s1-20261121-101500 --set training.learning_rate=0.0001
  daedalus train cartpole --set training.stop_when_solved=false --env-steps 5000000
  daedalus train cartpole --watch                (shows the run in a browser)
  daedalus train --env mpe2.simple_tag_v3        (its roles have different spaces: a learner and a run for each)

exit status: 0 the target was reached, or all steps were done without a target to stop at, 3 the budget was used up
before the target, 1 failed or stopped, 2 bad usage, 7 a newer learner of the run has taken over"""

_RESUME = """\
Continues a run from its newest undamaged checkpoint, with the same weights, optimiser state, counters and random state.
The environments start new episodes. With another budget, annealed settings continue from the values that they had."""

_RESUME_EXAMPLES = """\
examples:
  daedalus resume runs/cartpole-impala-s1-20261121-101500
  daedalus resume RUN_DIR --env-steps 3000000      (the whole budget, with the steps already done)
  daedalus resume RUN_DIR --set training.learning_rate=0.0001
  daedalus resume RUN_DIR --allow-module corridor      (the run plays corridor:Corridor-v0)

exit status: as of daedalus train"""


# After a signal: for a call that uses the disk, and then for the end of the child processes, of which the learner takes
# the longest
_DISK_SECONDS, _END_SECONDS = 10.0, 90.0


def train(arguments: list[str]) -> int:
    """Run `daedalus train` and return its exit status."""
    parsed, screen, started = _begun(train_parser(), arguments)
    try:
        _check_machine_options(parsed)
        new = new_run(parsed)
    except (SettingsError, *SECURITY_ERRORS) as error:
        print_error("train", error)
        return status_at_start(error)
    try:
        lock, run = create_run(new, started=started, fork=True)
        if parsed.set_role:
            lock.close()
            run_directory.remove_failed(lock.directory)
            raise SettingsError("--set-role is for games whose roles have different spaces: use --set")
    except RolesError as error:
        from daedalus.cli.commands.role_runs import train_roles

        return train_roles(parsed, new, error.roles, screen, started)
    except (RunInUseError, EnvironmentProblemError) as error:
        print_error("train", error)
        return 1
    except SettingsError as error:
        print_error("train", error)
        return status_at_start(error)
    with lock:
        run = replace(run, **machine_options(parsed, lock.directory))
        return _run(run, screen, lock, exits_with_parent=parsed.exit_with_parent)


def resume(arguments: list[str]) -> int:
    """Run `daedalus resume` and return its exit status."""
    parsed, screen, started = _begun(resume_parser(), arguments)
    try:
        _check_machine_options(parsed)
        if directories := run_directory.role_directories(parsed.directory):
            from daedalus.cli.commands.role_runs import resume_roles

            return resume_roles(parsed, directories, screen, started)
        _warn_of_role(parsed.directory)
        choice = resume_choice(parsed, parsed.directory)
        spec = choice.spec()
        lock, init_from = locked_to_resume(parsed.directory)
    except ModuleNotAllowedError as error:
        print_error("resume", allowing(error, ["daedalus", "resume", *arguments]))
        return 2
    except RunInUseError as error:
        print_error("resume", error)
        return 1
    except (SettingsError, UserModuleError, *SECURITY_ERRORS) as error:
        print_error("resume", error)
        return status_at_start(error)
    with lock:
        try:
            run = resumed_run(choice, spec, lock, init_from, started=started, fork=True)
        except (EnvironmentProblemError, SettingsError) as error:
            print_error("resume", error)
            return 1 if isinstance(error, EnvironmentProblemError) else status_at_start(error)
        if isinstance(run, FinishedRun):
            say(f"nothing to do: {run.reason}")
            return status_of(run)
        run = replace(run, **machine_options(parsed, lock.directory))
        return _run(run, screen, lock, exits_with_parent=parsed.exit_with_parent)


def resume_choice(parsed: argparse.Namespace, directory: Path) -> ResumeChoice:
    """Return what the options of `daedalus resume` choose for one run directory."""
    return ResumeChoice(
        directory=directory,
        env_steps=parsed.env_steps,
        assignments=parsed.set,
        allowed_modules=frozenset(parsed.allow_module),
        reset_statistics=parsed.reset_statistics,
    )


def _warn_of_role(directory: Path) -> None:
    """Warn if a run is one of several that play a game together."""
    parent = Path(os.path.abspath(directory)).parent
    roles = run_directory.role_directories(parent)
    if len(roles) > 1 and any(each.samefile(directory) for each in roles.values() if directory.exists()):
        _logger.warning(
            "%s is one role of a game: without their runs, the agents of the other roles take random actions. To "
            "continue all: daedalus resume %s",
            directory,
            shlex.quote(str(parent)),
        )


def train_parser() -> argparse.ArgumentParser:
    """Return the parser of `daedalus train`."""
    options = command_parser("train", _TRAIN, _TRAIN_EXAMPLES)
    add_settings(options)
    options.add_argument(
        "--set-role",
        nargs=2,
        action="append",
        default=[],
        metavar=("ROLE", "SECTION.KEY=VALUE"),
        help="a setting of one role's run, in a game whose roles have different spaces and so a run each. --set "
        "changes those of all roles",
    )
    add_new_run(options)
    _add_machine_options(options)
    return options


def resume_parser() -> argparse.ArgumentParser:
    """Return the parser of `daedalus resume`."""
    options = command_parser("resume", _RESUME, _RESUME_EXAMPLES)
    options.add_argument(
        "directory", type=Path, metavar="RUN_DIR", help="run to continue, or directory with the runs of several roles"
    )
    options.add_argument(
        "--env-steps", type=whole_number, metavar="N", help="new budget (default: the budget of the run)"
    )
    add_reset_statistics(options)
    options.add_argument(
        "--set",
        action="append",
        default=[],
        metavar="SECTION.KEY=VALUE",
        help="change a setting of the run from now on, such as training.learning_rate=0.0001. The environment, the "
        "network, the algorithm, the optimiser, the normalisation of rewards and the seed cannot change",
    )
    add_allow_module(options, "config.toml of the run")
    add_log(options)
    _add_machine_options(options)
    return options


def _add_machine_options(options: argparse.ArgumentParser) -> None:
    options.add_argument(
        "--listen",
        metavar="tcp/HOST:PORT",
        help="address where more actors may join (default: none; the processes of the run use a private Unix socket)",
    )
    options.add_argument(
        "--watch",
        action="store_true",
        help="show the run on a page in a browser, at http://127.0.0.1:8080, or at another port if that is taken. The "
        "token that it asks for is in RUN_DIR/operator-token. On a terminal the page stays after the end of the run, "
        "until Ctrl-C",
    )
    options.add_argument(
        "--clients",
        action="store_true",
        help="let every user of this machine take part at /actor and /play of that page (with --watch)",
    )
    options.add_argument("--no-camera", action="store_true", help="play no episodes for the page (with --watch)")
    add_inference(options)
    add_tls(options)
    add_insecure(options)
    add_logging(options)
    options.add_argument("--exit-with-parent", action="store_true", help=argparse.SUPPRESS)  # for `daedalus sweep`


def _begun(parser: argparse.ArgumentParser, arguments: list[str]) -> tuple[argparse.Namespace, Screen, float]:
    """Return the options, the terminal, with the logs on it, and when the process started."""
    started = process_started()
    parsed = parser.parse_args(arguments)
    screen = Screen()
    log_options(parsed).configure(write=screen.out)
    signal.signal(signal.SIGTERM, signal.default_int_handler)  # as Ctrl-C, until the run has handlers of its own
    return parsed, screen, started


def _check_machine_options(parsed: argparse.Namespace) -> None:
    """Raise SettingsError, or one of SECURITY_ERRORS, for options that this machine cannot follow."""
    credentials_to_listen([parsed.listen] if parsed.listen else [], parsed.tls, "learner", insecure=parsed.insecure)
    if parsed.clients and not parsed.watch:
        raise SettingsError("--clients is for the page of the run: add --watch, or start `daedalus gateway`")
    if parsed.watch:
        from daedalus.launch.gateway_process import GATEWAY_PACKAGES, INSTALL  # with what a gateway imports

        if not all(map(importlib.util.find_spec, GATEWAY_PACKAGES)):
            raise SettingsError(f"--watch: {INSTALL}")
    try:
        check_inference(parsed.inference)
    except ValueError as error:
        raise SettingsError(str(error)) from None


def machine_options(parsed: argparse.Namespace, directory: Path) -> dict[str, Any]:
    """Return the fields of a LocalRun that `_add_machine_options` and `add_log` define."""
    return {
        "inference": parsed.inference,
        "listen": parsed.listen,
        "tls": parsed.tls,
        "insecure": parsed.insecure,
        "watch": parsed.watch,
        "keeps_page": parsed.watch and is_terminal(sys.stdout) and not log_options(parsed).as_json,
        "clients": parsed.clients,
        "camera": not parsed.no_camera,
        "log": chosen_trackers(parsed.log, directory),
        "logs": log_options(parsed),
    }


def _run(run: LocalRun, screen: Screen, lock: RunLock, *, exits_with_parent: bool) -> int:
    """Run to the end, leave a report, print the result, and return the exit status.

    A finished run is only evaluated.
    """
    directory = run.directory
    live = screen.shows_frames and not run.logs.as_json
    command = "daedalus resume" if run.resume else "daedalus train"
    if live:
        run = replace(run, observer=TrainingDisplay(screen, run_directory.run_name(directory)))
    output = ChildOutput(directory / run_directory.OUTPUT, screen.out, screen.err)
    stopping = stopping_event(exits_with_parent=exits_with_parent)

    def show_end(end: RunEnd) -> None:
        show("\n".join([report(run, end.summary), left_report(directory)]), command)
        lock.close()  # the page that is kept does not keep anybody from resuming the run
        if run.keeps_page:
            say("the page of the run stays open: press Ctrl-C to close it")

    try:
        with output:
            streams = output.unlimited_pipes if live else inherited
            return run_locally(run, stopping, output, streams, show_end).status
    except RunStoppedError as error:
        show("\n".join(filter(None, [left_report(directory), stopped_text(error, resume_command(run))])), command)
        return 1
    except RunFailedError as error:
        if str(error):
            say(f"{command}: {str(error).rstrip()}", sys.stderr)
        if not (run.resume or output.withheld or isinstance(error, UnsavedError)):
            run_directory.remove_failed(directory)
        if left := left_report(directory):
            say(left, sys.stderr)
        if not isinstance(error, UnsavedError) and checkpoints(directory):
            say(f"when that is corrected, continue with: {resume_command(run)}", sys.stderr)
        return error.status


def stopping_event(*, exits_with_parent: bool) -> threading.Event:
    """Return the event that a signal sets, or the end of the process that started this one."""
    # A disk that does not answer may hold this thread. The child processes then end with this one, by themselves.
    stopping = stop_on_signals(exit_if_stuck=True, stuck_seconds=_DISK_SECONDS, end_seconds=_END_SECONDS)
    if exits_with_parent:
        exit_with_parent(stopping)
    return stopping


def stopped_text(error: RunStoppedError, resume: str) -> str:
    """Return who stopped the training, and the command that continues it."""
    return f"stopped{f' by {error}' if str(error) else ''}; continue with: {resume}"


def left_report(directory: Path) -> str:
    """Write the report of a run; return the line that names it or says why there is none. Empty without metrics."""
    if not (directory / run_directory.METRICS).exists():
        return ""
    from daedalus.cli.commands.report import write_report  # imports the analysis of runs, which training does not need

    try:
        return f"report: {write_report(directory)}"
    except ModuleNotFoundError:
        shown = shlex.quote(str(directory))
        return f'for a report with the curves: pip install "daedalus-rl[analysis]", then: daedalus report {shown}'
    except Exception as error:  # the result of a run, and its exit status, do not depend on a report
        return f"no report: {error if isinstance(error, RunDataError) else f'{type(error).__name__}: {error}'}"


def report(run: LocalRun, summary: dict[str, Any]) -> str:
    """Return the result of a run from its summary.json, with the evaluation if it has one."""
    target = run.spec.target
    skipped = f" ({summary['updates_skipped']:,} skipped)" if summary.get("updates_skipped") else ""
    updates = f"{summary['updates']:,} updates{skipped}"
    if summary["solved"]:
        trained = (
            f"solved: {target} reached after {summary['seconds_to_target']:.1f} s; "
            f"{summary['env_steps']:,} env_steps, {updates} in all"
        )
    else:
        goal = f" (the target, {target}, was not reached)" if target else ""
        trained = f"done: {summary['env_steps']:,} env_steps, {updates}{goal}"
    lines = [trained, *_rated(summary), *_confirmed(run, summary)]
    evaluation = summary.get("evaluation")
    if evaluation is None:
        folder = shlex.quote(str(run.directory))
        return "\n".join([*lines, f"not evaluated (evaluation.final_episodes=0): daedalus evaluate {folder}"])
    evaluated = (
        f"evaluation: return {short_number(evaluation['return_mean'])} +- {short_number(evaluation['return_std'])} "
        f"over {evaluation['episodes']} {evaluation['actions']} episodes of the "
        f"{'best' if evaluation['best_checkpoint'] else 'newest'} checkpoint "
        f"on {evaluation['environment']} (backend {evaluation['backend']})"
    )
    if "matches" in evaluation:
        evaluated = f"evaluation of the newest checkpoint, {evaluation['actions']} actions: {evaluation['summary']}"
    return "\n".join([*lines, evaluated, *evaluation["notes"]])


def _rated(summary: dict[str, Any]) -> list[str]:
    """Return the line about the rating of the newest policy in a game with opponents, if it has one."""
    league = LeagueStatus() if summary.get("league") is None else LeagueStatus.model_validate(summary["league"])
    if league.newest is None:
        return []
    wins = ", ".join(f"{short_share(rate)} against {name}" for name, rate in league.win_rates.items())
    rating = f"league: rating {league.newest.text} of the newest policy"
    return [printable(f"{rating}; wins {wins}" if wins else rating)]


def show(text: str, command: str) -> None:
    """Print the result of a run. A full disk is no fault of the run: standard error has one line of `command` then."""
    try:
        say(text)
    except OSError as error:
        if error.errno not in UNWRITABLE:
            raise
        discard(sys.stdout)
        with suppress(OSError):
            message = f"cannot print the result, which is in the run directory: {error.strerror}"
            say(f"{command}: {message}", sys.stderr)


def _confirmed(run: LocalRun, summary: dict[str, Any]) -> list[str]:
    """Return the line about the new episodes that confirm "solved", if there is one."""
    confirmation = summary.get("confirmation")
    if confirmation is None:
        return []
    line = (
        f"confirmation: return {short_number(confirmation['return_mean'])} over {confirmation['episodes']} new sampled "
        "episodes of the policy at that moment"
    )
    if confirmation["interval"] is not None:
        line += ", 95 % interval {} to {}".format(*map(short_number, confirmation["interval"]))
    if run.spec.trains_true_task:
        line += f"; training mean {short_number(summary['episode_return_mean'])}"
    return [line]
