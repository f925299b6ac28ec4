"""`daedalus learner`: construct one learner and run it.

Exit status: 0 the target was reached, all steps were done without a target to stop at, or a signal stopped the learner
and its checkpoint is saved; 3 the budget was used up before the target; 1 failed; 2 bad usage. Under `daedalus train` a
learner that a signal stopped exits with processes.STOPPED, and one that an operator stopped with processes.ORDERED.
"""

import argparse
import logging
import sys
import threading
import time
from contextlib import ExitStack
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from daedalus.algorithms.errors import AlgorithmError
from daedalus.cli.arguments import allowing
from daedalus.cli.logs import configure_logging
from daedalus.cli.own_algorithm import with_record
from daedalus.cli.processes import (
    ORDERED,
    STOPPED,
    exit_on_thread_exceptions,
    exit_status,
    exit_with_parent,
    raise_descriptor_limit,
    stop_on_signals,
)
from daedalus.cli.quick_check import expected_defaults, expected_spaces
from daedalus.cli.settings_arguments import LISTEN, ChosenRun, choose_run, learner_parser, resolve
from daedalus.learner.reporting.csv_writer import CsvWriter
from daedalus.learner.reporting.progress import Progress
from daedalus.learner.reporting.recorder import OpenWriter
from daedalus.learner.reporting.tensorboard_writer import TensorBoardWriter
from daedalus.learner.reporting.user_metrics import RowsWriter, UserMetrics
from daedalus.learner.run import run_directory
from daedalus.learner.run.finished import finished_run
from daedalus.learner.run.heartbeat import Heartbeat
from daedalus.learner.run.run_lock import RunLock
from daedalus.learner.run.settings import SettingsError
from daedalus.learner.service import LearnerService, Outcome
from daedalus.learner.serving.rollout_intake import largest_request
from daedalus.learner.training.allocator import keep_freed_memory
from daedalus.learner.training.errors import CheckpointMismatchError
from daedalus.policy.network.errors import NetworkError
from daedalus.policy.saving.saved_policy import checkpoints, find_policy
from daedalus.policy.saving.sealed import DamagedError
from daedalus.policy.user_modules import ModuleNotAllowedError, UserModuleError, allow_settings
from daedalus.protocol.spaces import Spaces
from daedalus.protocol.spec import RunSpec
from daedalus.transport.connecting import connect_with_retry, listen
from daedalus.transport.credentials import Credentials, CredentialsError
from daedalus.transport.interface import Transport, TransportError
from daedalus.transport.reachable import reachable
from daedalus.transport.security import (
    SECURITY_ERRORS,
    certificate_days_left,
    credentials_to_connect,
    credentials_to_listen,
)

_logger = logging.getLogger("daedalus.cli")  # this module is __main__ when it runs

if TYPE_CHECKING:
    from daedalus.learner.training.checkpoint import Checkpoint

REACHED, FAILED, BAD_USAGE, NOT_REACHED = 0, 1, 2, 3
_FAILURES = (
    AlgorithmError,
    CheckpointMismatchError,
    CredentialsError,
    DamagedError,
    NetworkError,
    SettingsError,
    TransportError,
)


def main() -> int:
    """Run `daedalus learner` and return its exit status."""
    started = time.monotonic()
    arguments = learner_parser().parse_args()
    keep_freed_memory()
    raise_descriptor_limit()
    stop = stop_on_signals()
    user_metrics = UserMetrics()
    if arguments.exit_with_parent:
        exit_with_parent(stop, user_metrics.add_line)
    try:
        run = choose_run(arguments)
        credentials = _credentials(arguments)
    except ModuleNotAllowedError as error:
        print(f"daedalus learner: {allowing(error, ['daedalus', 'learner', *sys.argv[1:]])}", file=sys.stderr)
        return BAD_USAGE
    except (SettingsError, UserModuleError, *SECURITY_ERRORS) as error:
        print(f"daedalus learner: {error}", file=sys.stderr)
        return BAD_USAGE
    progress = Progress(sys.stdout, run.spec.training.env_steps)
    context = {"run": run.directory.name}
    process = "" if arguments.prepared else "learner"  # the launcher shows the lines to a person
    configure_logging(
        arguments.log_level, as_json=arguments.log_json, process=process, context=context, write=progress.say
    )
    try:
        with ExitStack() as stack:
            began = arguments.started or started
            return _serve(run, arguments, credentials, stop, progress, began, user_metrics, context, stack)
    except _FAILURES as error:
        print(f"daedalus learner: {error}", file=sys.stderr)
        return FAILED


def _serve(
    run: ChosenRun,
    arguments: argparse.Namespace,
    credentials: Credentials | None,
    stop: threading.Event,
    progress: Progress,
    started: float,
    user_metrics: UserMetrics,
    context: dict[str, str],
    stack: ExitStack,
) -> int:
    """Run the learner to its end and return the exit status. Raises _FAILURES.

    `context` receives the fields of the log; `stack` closes what is opened.
    """
    if run.exists and arguments.prepared is None:  # the launcher of a prepared run has locked it
        stack.enter_context(RunLock(run.directory))
    Heartbeat(run.directory).clear()  # before a router is waited for
    resumed = arguments.resume and run.exists
    finished = finished_run(run.directory, run.spec) if resumed else None
    if finished is not None:
        _logger.info("nothing to do: %s", finished.reason)
        return NOT_REACHED if finished.missed else REACHED
    restored = _newest_checkpoint(run.directory) if resumed else None
    spaces = arguments.spaces
    if restored is None and arguments.prepared is None:
        run, spaces = _with_spaces(run, arguments, stop)
    initial = find_policy(arguments.init_from) if arguments.init_from is not None and restored is None else None
    transport = _open_transport(arguments, run.spec, credentials, stop)
    stopped = STOPPED if arguments.prepared else 0
    if transport is None:  # stopped while no router answered
        return stopped
    stack.callback(transport.close)
    if not run.exists:
        new = {"numbered": arguments.run_dir is None, "init_from": arguments.init_from}
        lock = stack.enter_context(run_directory.create_locked(run.directory, run.spec, **new))
        run = replace(run, directory=lock.directory)
        context["run"] = run.directory.name
    try:
        service = LearnerService(
            run.spec,
            run.directory,
            transport,
            stop,
            progress,
            _writers(run.directory, arguments.rows_to),
            started=started,
            restored=restored,
            initial=initial,
            spaces=spaces,
            modules=run.modules,
            certificate_days_left=partial(certificate_days_left, credentials),
            user_metrics=user_metrics,
        )
        context["epoch"] = f"{service.learner_epoch:x}"
        _announce(run, arguments, credentials)
        outcome = service.run()
    except _FAILURES:
        if not run.exists:
            run_directory.remove_failed(run.directory)
        raise
    return _status(outcome, run.spec, stopped)


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
    return replace(run, spec=chosen, directory=directory), spaces


def _credentials(arguments: argparse.Namespace) -> Credentials | None:
    """Return the credentials for the addresses, or None without TLS. Raises SECURITY_ERRORS."""
    if arguments.connect:
        return credentials_to_connect(arguments.connect, arguments.tls, "learner")
    return credentials_to_listen(_addresses(arguments), arguments.tls, "learner", insecure=arguments.insecure)


def _addresses(arguments: argparse.Namespace) -> list[str]:
    """Return the addresses that actors connect to."""
    return arguments.connect or arguments.listen or [LISTEN]


def _open_transport(
    arguments: argparse.Namespace, spec: RunSpec, credentials: Credentials | None, stop: threading.Event
) -> Transport | None:
    """Connect to a router or listen for actors; return None if stopped before a router answered.

    Raises TransportError or CredentialsError.
    """
    limit = largest_request(spec)
    if arguments.connect:
        return connect_with_retry(arguments.connect, stop, credentials=credentials, max_message_bytes=limit)
    return listen(_addresses(arguments), credentials=credentials, max_message_bytes=limit)


def how_to_join(listening: list[str], credentials: Credentials | None, spec: RunSpec) -> str:
    """Return the command of an actor, with the other addresses that it may use."""
    address, *others = reachable(listening, credentials.hosts() if credentials else ())
    tls = ["--tls", "DIR"] if credentials else []
    command = ["daedalus actor --connect", address, *tls, *allow_settings(spec.actor_modules)]
    return " ".join([*command, *([f"(or at {', '.join(others)})"] if others else [])])


def _announce(run: ChosenRun, arguments: argparse.Namespace, credentials: Credentials | None) -> None:
    """Log how actors join."""
    if arguments.prepared is None:
        spec = run.spec
        _logger.info("run %s: learning %s with %s", run.directory, spec.environment.id, spec.training.algorithm)
        _logger.info("actors join with: %s", how_to_join(_addresses(arguments), credentials, spec))


def _writers(directory: Path, rows_to: int | None) -> list[OpenWriter]:
    """Return the metrics writers; `rows_to` is a pipe to the program that started the run."""
    writers: list[OpenWriter] = [
        lambda: CsvWriter(directory / run_directory.METRICS),
        lambda: TensorBoardWriter(directory),
    ]
    return writers if rows_to is None else [lambda: RowsWriter(rows_to), *writers]


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


def _status(outcome: Outcome, spec: RunSpec, stopped: int) -> int:
    """Return the exit status for the end of a run; `stopped` is that of a run that was stopped."""
    if not outcome.finished:
        if outcome.ordered and stopped and outcome.saved:
            return ORDERED
        return stopped if outcome.saved else FAILED
    wanted = spec.training.target_return is not None and spec.training.stop_when_solved
    return NOT_REACHED if wanted and not outcome.solved else REACHED


if __name__ == "__main__":
    exit_on_thread_exceptions()
    sys.exit(exit_status(main))
