"""`daedalus learner`: constructs one learner and runs it.

Exit status: 0 the target was reached or the asked-for steps were done, 3 the budget ended without the target,
1 failed or stopped early, 2 bad usage.
"""

import argparse
import logging
import sys
import time
from pathlib import Path
from typing import TYPE_CHECKING

from daedalus.cli.logs import configure_logging
from daedalus.cli.processes import exit_on_thread_exceptions, exit_with_parent, stop_on_signals
from daedalus.cli.settings_arguments import LISTEN, learner_parser, resolve, resolve_again
from daedalus.learner.reporting.csv_writer import CsvWriter
from daedalus.learner.reporting.progress import Progress
from daedalus.learner.reporting.tensorboard_writer import TensorBoardWriter
from daedalus.learner.run import run_directory
from daedalus.learner.run.settings import SettingsError
from daedalus.learner.service import LearnerService, Outcome
from daedalus.learner.training.allocator import keep_freed_memory
from daedalus.learner.training.errors import CheckpointMismatchError
from daedalus.policy.network.errors import NetworkError
from daedalus.policy.saving.saved_policy import checkpoints
from daedalus.policy.saving.sealed import DamagedError
from daedalus.protocol.spec import RunSpec
from daedalus.transport.connecting import connect_with_retry
from daedalus.transport.credentials import CredentialsError
from daedalus.transport.interface import TransportError
from daedalus.transport.security import SECURITY_ERRORS, credentials_to_connect, credentials_to_listen
from daedalus.transport.zenoh_transport import listen

_logger = logging.getLogger("daedalus.cli")  # this module is __main__ when it runs

if TYPE_CHECKING:
    from daedalus.learner.training.checkpoint import Checkpoint

REACHED, FAILED, BAD_USAGE, NOT_REACHED = 0, 1, 2, 3


def main() -> int:
    """Runs `daedalus learner`."""
    started = time.monotonic()
    arguments = learner_parser().parse_args()
    keep_freed_memory()
    stop = stop_on_signals()
    if arguments.exit_with_parent:
        exit_with_parent(stop)
    try:
        spec, directory, begun = _what(arguments)
        addresses = arguments.listen or [LISTEN]
        if arguments.connect:
            credentials = credentials_to_connect(arguments.connect, arguments.tls, "learner")
        else:
            credentials = credentials_to_listen(addresses, arguments.tls, "learner", insecure=arguments.insecure)
    except (SettingsError, *SECURITY_ERRORS) as error:
        print(f"daedalus learner: {error}", file=sys.stderr)
        return BAD_USAGE
    progress = Progress(sys.stdout, spec.training.env_steps)
    configure_logging(arguments.log_level, as_json=arguments.log_json, write=progress.say)
    try:
        restored = None
        if arguments.resume and begun:
            restored = _newest_checkpoint(directory)
        if arguments.connect:
            transport = connect_with_retry(arguments.connect, stop, credentials=credentials)
        else:
            transport = listen(addresses, credentials=credentials)
        if transport is None:
            return FAILED
    except (TransportError, DamagedError, CredentialsError) as error:
        print(f"daedalus learner: {error}", file=sys.stderr)
        return FAILED
    try:
        if not begun:
            run_directory.create(directory, spec)
        if arguments.prepared is None:
            there = ", ".join(arguments.connect or addresses)
            _logger.info(f"run {directory}: learning {spec.environment.id} with {spec.training.algorithm}")
            _logger.info(f"actors join with: daedalus actor --connect {there}")
        service = LearnerService(
            spec,
            directory,
            transport,
            stop,
            progress,
            [lambda: CsvWriter(directory / run_directory.METRICS), lambda: TensorBoardWriter(directory)],
            started=arguments.started or started,
            restored=restored,
        )
        return _status(service.run(), spec)
    except (CheckpointMismatchError, NetworkError, SettingsError, TransportError) as error:
        print(f"daedalus learner: {error}", file=sys.stderr)
        return FAILED
    finally:
        transport.close()


def _what(arguments: argparse.Namespace) -> tuple[RunSpec, Path, bool]:
    """The run to learn, where it goes, and whether it was begun before. Raises SettingsError."""
    if arguments.prepared:
        return run_directory.read_config(arguments.prepared), arguments.prepared, True
    if arguments.resume:
        spec, directory, begun = resolve_again(arguments)
    else:
        spec, directory = resolve(arguments)
        begun = False
    if not begun:
        run_directory.check_free(directory)
    return spec, directory, begun


def _newest_checkpoint(directory: Path) -> "Checkpoint | None":
    """What to go on from; None if the run ended before its first checkpoint. Raises DamagedError if none is whole."""
    if not checkpoints(directory):
        _logger.info("there is no checkpoint yet: the run starts from its beginning")
        return None
    from daedalus.learner.training.checkpoint import load_newest

    restored = load_newest(directory)
    steps = restored.counters["env_steps"]
    _logger.info(f"going on from checkpoint {restored.policy.policy_version} at {steps:,} env_steps")
    return restored


def _status(outcome: Outcome, spec: RunSpec) -> int:
    if not outcome.finished:
        return FAILED
    wanted = spec.training.target_return is not None and spec.training.stop_when_solved
    return NOT_REACHED if wanted and not outcome.solved else REACHED


if __name__ == "__main__":
    exit_on_thread_exceptions()
    sys.exit(main())
