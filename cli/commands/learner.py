"""`daedalus learner`: construct one learner and run it.

Exit status: 0 the target was reached, all steps were done without a target to stop at, or a signal stopped the learner
and its checkpoint is saved; 3 the budget was used up before the target; 1 failed, or the last checkpoint could not be
saved; 2 bad usage; 7 a newer learner of the run has taken over. Under `daedalus train` a learner that a signal stopped
exits with processes.STOPPED, and one that an operator stopped with processes.ORDERED. A supervised learner whose last
checkpoint could not be saved exits with processes.UNSAVED.
"""

import argparse
import logging
import sys
import threading
import time
from contextlib import ExitStack
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from daedalus.cli.arguments import allowing
from daedalus.cli.child_output import ChildOutput
from daedalus.cli.evaluation_processes import EvaluationFailedError
from daedalus.cli.learner_network import announce, learner_credentials, open_transport
from daedalus.cli.logs import configure_logging, print_error
from daedalus.cli.own_algorithm import with_record
from daedalus.cli.processes import (
    BAD_USAGE,
    FAILED,
    ORDERED,
    STOPPED,
    SUPERSEDED,
    UNSAVED,
    exit_on_thread_exceptions,
    exit_status,
    exit_with_parent,
    raise_descriptor_limit,
    status_at_start,
    stop_on_signals,
)
from daedalus.cli.quick_check import expected_defaults, expected_spaces
from daedalus.cli.running.confirmation import Confirmations
from daedalus.cli.settings_arguments import ChosenRun, choose_run, learner_parser, resolve
from daedalus.cli.tracking.tracker_processes import TrackerProcesses
from daedalus.learner.reporting.csv_writer import CsvWriter
from daedalus.learner.reporting.progress import Progress, SilentProgress
from daedalus.learner.reporting.recorder import OpenWriter
from daedalus.learner.reporting.tensorboard_writer import TensorBoardWriter
from daedalus.learner.reporting.trackers.tracking import chosen_trackers
from daedalus.learner.reporting.user_metrics import RowsWriter, UserMetrics
from daedalus.learner.run import run_directory
from daedalus.learner.run.heartbeat import Heartbeat
from daedalus.learner.run.process_resources import keep_freed_memory, reserve_descriptors
from daedalus.learner.run.resuming import (
    Beginning,
    CheckpointMismatchError,
    allows_other_spaces,
    finished_run,
    initial_to_resume,
)
from daedalus.learner.run.run_lock import RunLock
from daedalus.learner.run.settings import SettingsError
from daedalus.learner.service import LearnerService, Outcome, Outputs
from daedalus.learner.serving.run_context import RunContext
from daedalus.policy.saving.saved_policy import NoPolicyError, SavedPolicy, checkpoints, find_policy
from daedalus.policy.saving.sealed import DamagedError
from daedalus.policy.user_code import Surroundings
from daedalus.policy.user_modules import ModuleNotAllowedError, NetworkError, UserModuleError, allow_words, modules_of
from daedalus.protocol.algorithms import AlgorithmError
from daedalus.protocol.spaces import Spaces
from daedalus.protocol.spec import RunSpec
from daedalus.transport.credentials import (
    SECURITY_ERRORS,
    Credentials,
    CredentialsError,
    certificate_days_left,
)
from daedalus.transport.interface import Transport, TransportError

_logger = logging.getLogger("daedalus.cli")  # this module is __main__ when it runs

if TYPE_CHECKING:
    from daedalus.learner.training.checkpoint import Checkpoint

_POLL_SECONDS = 0.05  # until a target that was reached is noticed
_END_SECONDS = 4.0  # for the process that plays to end
_UPDATE_SECONDS = 120.0  # longer than one takes

REACHED, NOT_REACHED = 0, 3
_FAILURES = (
    AlgorithmError,
    CheckpointMismatchError,
    CredentialsError,
    DamagedError,
    NetworkError,
    NoPolicyError,
    SettingsError,
    TransportError,
)


def main() -> int:
    """Run `daedalus learner` and return its exit status."""
    started = time.monotonic()
    arguments = learner_parser().parse_args()
    here = Surroundings().directory  # a network or an algorithm of the user may change it
    keep_freed_memory()
    raise_descriptor_limit()
    reserve_descriptors()
    # An update may take long. A disk that does not answer may hold this thread for ever.
    stop = stop_on_signals(exit_if_stuck=True, stuck_seconds=_UPDATE_SECONDS)
    user_metrics = UserMetrics()
    if arguments.exit_with_parent:
        exit_with_parent(stop, user_metrics.add_line)
    try:
        credentials = learner_credentials(arguments)
        run = choose_run(arguments)
        run = replace(run, directory=here / run.directory)
        if arguments.init_from is not None:
            arguments.init_from = here / arguments.init_from
    except ModuleNotAllowedError as error:
        print_error("learner", allowing(error, ["daedalus", "learner", *sys.argv[1:]]))
        return BAD_USAGE
    except (SettingsError, UserModuleError, *SECURITY_ERRORS) as error:
        print_error("learner", error)
        return status_at_start(error)
    display = SilentProgress if arguments.no_progress else Progress
    progress = display(sys.stdout, run.spec.training.env_steps)
    context = {"run": run_directory.run_name(run.directory)}
    process = "" if arguments.prepared else "learner"  # the launcher shows the lines to a person
    configure_logging(
        arguments.log_level, as_json=arguments.log_json, process=process, context=context, write=progress.say
    )
    try:
        command = _Command(
            arguments=arguments,
            credentials=credentials,
            stop=stop,
            progress=progress,
            started=arguments.started or started,
            user_metrics=user_metrics,
            context=context,
        )
        with ExitStack() as stack:
            return command.serve(run, stack)
    except _FAILURES as error:
        print_error("learner", error)
        return FAILED


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Command:
    """What one `daedalus learner` was started with, besides its run."""

    arguments: argparse.Namespace
    credentials: Credentials | None
    stop: threading.Event
    progress: Progress
    started: float  # on the monotonic clock
    user_metrics: UserMetrics
    context: dict[str, str]  # receives the fields of the log

    def serve(self, run: ChosenRun, stack: ExitStack) -> int:
        """Run the learner to its end and return the exit status; `stack` closes what is opened.

        Raises _FAILURES.
        """
        arguments = self.arguments
        if run.exists and arguments.prepared is None:  # the launcher of a prepared run has locked it
            stack.enter_context(RunLock(run.directory))
        if arguments.run_dir is not None:
            stack.enter_context(run_directory.made(run.directory))  # before a router is waited for, for status --alive
        Heartbeat(run.directory).clear()
        resumed = arguments.resume and run.exists
        if resumed and (reason := run_directory.why_superseded(run.directory)):
            print_error("learner", reason)
            return SUPERSEDED
        finished = finished_run(run.directory, run.spec) if resumed else None
        if finished is not None:
            _logger.info("nothing to do: %s", finished.reason)
            return NOT_REACHED if finished.missed else REACHED
        if run.changed:
            _logger.info("settings of the run changed: %s", ", ".join(run.changed))
            run_directory.write_config(run.directory, run.spec)
        restored = _newest_checkpoint(run.directory) if resumed else None
        spaces = arguments.spaces
        if restored is None and arguments.prepared is None:
            run, spaces = _with_spaces(run, arguments, self.stop)
        weights = arguments.init_from or (initial_to_resume(run.directory) if resumed else None)
        initial = find_policy(weights) if weights is not None and restored is None else None
        transport = open_transport(arguments, run.spec, self.credentials, self.stop)
        stopped = STOPPED if arguments.prepared else 0
        if transport is None:  # stopped while no router answered
            return stopped
        stack.callback(transport.close)
        run = run if run.exists else self._with_directory(run, stack)
        try:
            service = self._service(run, transport, restored, initial, spaces)
            announce(run, arguments, self.credentials)
            if arguments.prepared is None:  # else the launcher starts them
                output = stack.enter_context(
                    ChildOutput(run.directory / run_directory.OUTPUT, self.progress.say, self.progress.say)
                )
                _start_trackers(run.directory, arguments, output, self.stop, stack)
                if _confirms(run.spec):
                    _start_confirmations(run, arguments, output, self.stop, stack)
            outcome = service.run()
            if outcome.superseded_by is not None:
                _note_superseded(run.directory, outcome.superseded_by)
        except _FAILURES:
            if not run.exists:
                run_directory.remove_failed(run.directory)
            raise
        return _status(outcome, run.spec, stopped, UNSAVED if arguments.exit_with_parent else FAILED)

    def _with_directory(self, run: ChosenRun, stack: ExitStack) -> ChosenRun:
        """Create the directory of a new run, and return the run in it; `stack` unlocks it."""
        arguments = self.arguments
        new = {
            "numbered": arguments.run_dir is None,
            "init_from": arguments.init_from,
            "other_spaces": arguments.allow_other_spaces,
        }
        lock = stack.enter_context(run_directory.create_locked(run.directory, run.spec, **new))
        self.context["run"] = run_directory.run_name(lock.directory)
        return replace(run, directory=lock.directory)

    def _service(
        self,
        run: ChosenRun,
        transport: Transport,
        restored: "Checkpoint | None",
        initial: SavedPolicy | None,
        spaces: Spaces | None,
    ) -> LearnerService:
        arguments = self.arguments
        context = RunContext.begin(
            run.directory, run.spec, self.stop, started=self.started, spaces=spaces, restored=restored
        )
        context.health.certificate_days_left = partial(certificate_days_left, self.credentials)
        beginning = Beginning(
            restored=restored,
            initial=initial,
            allows_other_spaces=arguments.allow_other_spaces or allows_other_spaces(run.directory),
            reset_statistics=arguments.reset_statistics,
            modules=run.modules,
        )
        writers = _writers(run.directory, arguments.rows_to)
        outputs = Outputs(progress=self.progress, writers=writers, user_metrics=self.user_metrics)
        self.context["epoch"] = f"{context.learner_epoch:x}"
        confirms = arguments.confirm or (arguments.prepared is None and _confirms(run.spec))
        return LearnerService(context, transport, outputs, beginning, confirms=confirms)


def _with_spaces(
    run: ChosenRun, arguments: argparse.Namespace, stop: threading.Event
) -> tuple[ChosenRun, Spaces | None]:
    """Return the run with the default settings of its spaces, and the spaces; None if they are not known here."""
    if arguments.env is None or run.exists:
        return run, expected_spaces(run.spec, run.modules, stop)
    spaces, defaults = expected_defaults(run.spec, run.modules, stop)
    chosen, directory = resolve(arguments, defaults)
    chosen = with_record(chosen, run.modules)
    if spaces is not None and chosen.environment != run.spec.environment:
        spaces = expected_spaces(chosen, run.modules, stop)
    return replace(run, spec=chosen, directory=run.directory.with_name(directory.name)), spaces


def _writers(directory: Path, rows_to: int | None) -> list[OpenWriter]:
    """Return the metrics writers; `rows_to` is a pipe to the program that started the run."""
    writers: list[OpenWriter] = [
        lambda: CsvWriter(directory / run_directory.METRICS),
        lambda: TensorBoardWriter(directory),
    ]
    return writers if rows_to is None else [lambda: RowsWriter(rows_to), *writers]


def _start_trackers(
    directory: Path, arguments: argparse.Namespace, output: ChildOutput, stop: threading.Event, stack: ExitStack
) -> None:
    """Start the chosen trackers and those that have logged the run before; `stack` ends them."""
    names = chosen_trackers(arguments.log, directory)
    if names:
        trackers = TrackerProcesses(names, directory, output, service=True, log_json=arguments.log_json)
        stack.callback(trackers.finish, stop)
        trackers.start()


def _confirms(spec: RunSpec) -> bool:
    return spec.training.target_return is not None and spec.training.stop_when_solved


def _start_confirmations(
    run: ChosenRun, arguments: argparse.Namespace, output: ChildOutput, stop: threading.Event, stack: ExitStack
) -> None:
    """Play new episodes here when the target is reached, as `daedalus train` does; `stack` ends them.

    Only what actors report says that it is reached. Where the environment cannot be made, that counts.
    """
    allowed = allow_words(
        module for module in modules_of(run.spec.environment.user_modules) if module in run.modules.allowed
    )
    options = ["--log-level", arguments.log_level, *(["--log-json"] if arguments.log_json else []), *allowed]
    confirmations, ended = Confirmations(run.directory, run.spec, options, output), threading.Event()

    def play() -> None:
        try:
            while not ended.wait(_POLL_SECONDS):
                confirmations.poll()
        except EvaluationFailedError as error:  # the learner waits for a result that it cannot get
            _logger.error("%s", error)
            stop.set()
        finally:
            confirmations.close()

    thread = threading.Thread(target=play, name="confirmations", daemon=True)
    thread.start()
    stack.callback(thread.join, _END_SECONDS)
    stack.callback(ended.set)


def _newest_checkpoint(directory: Path) -> "Checkpoint | None":
    """Return the newest undamaged checkpoint, or None if there is none yet. Raises DamagedError if all are damaged."""
    if not checkpoints(directory):
        _logger.info("no checkpoint found: the run starts from the beginning")
        return None
    from daedalus.learner.training.checkpoint import load_newest

    restored = load_newest(directory)
    steps = f"{restored.counters['env_steps']:,}"
    _logger.info("resuming from checkpoint %d at %s env_steps", restored.policy.policy_version, steps)
    return restored


def _note_superseded(directory: Path, learner_epoch: int) -> None:
    try:
        run_directory.note_superseded(directory, learner_epoch)
    except OSError as error:
        _logger.error("%s cannot be written, so do not start this learner again: %s", directory, error.strerror)


def _status(outcome: Outcome, spec: RunSpec, stopped: int, unsaved: int) -> int:
    """Return the exit status for the end of a run.

    `stopped` is that of a run that was stopped, and `unsaved` that of a run whose last checkpoint could not be saved.
    """
    if outcome.superseded_by is not None:
        return SUPERSEDED
    if not outcome.saved:
        return unsaved
    if not outcome.finished:
        return ORDERED if outcome.ordered and stopped else stopped
    wanted = spec.training.target_return is not None and spec.training.stop_when_solved
    return NOT_REACHED if wanted and not outcome.solved else REACHED


if __name__ == "__main__":
    exit_on_thread_exceptions()
    sys.exit(exit_status(main))
