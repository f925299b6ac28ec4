"""`python -m learner`: constructs one learner and runs it.

Exit status: 0 the target was reached or the asked-for steps were done, 3 the budget ended without the target,
1 failed or stopped early, 2 bad usage.
"""

import argparse
import sys
import time
from pathlib import Path
from typing import TYPE_CHECKING

from learner import run_directory
from learner.allocator import keep_freed_memory
from learner.options import LISTEN, learner_parser, resolve, resolve_again
from learner.progress import Progress
from learner.service import LearnerService, Outcome
from learner.settings import SettingsError
from policy.saved_policy import checkpoints
from policy.sealed import DamagedError
from protocol.command_line import SECURITY_ERRORS, credentials_to_connect, credentials_to_listen
from protocol.connecting import connect_when_there
from protocol.credentials import CredentialsError
from protocol.process import exit_with_parent, stop_on_signals
from protocol.spec import RunSpec
from protocol.transport import TransportError
from protocol.zenoh_transport import listen

if TYPE_CHECKING:
    from learner.checkpoint import Checkpoint

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
    try:
        restored = None
        if arguments.resume and begun:
            restored = _newest_checkpoint(directory, progress)
        if arguments.connect:
            transport = connect_when_there(arguments.connect, stop, progress.say, credentials=credentials)
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
            progress.say(f"run {directory}: learning {spec.environment.id} with {spec.training.algorithm}")
            progress.say(f"actors join with: daedalus actor --connect {there}")
        service = LearnerService(
            spec,
            directory,
            transport,
            stop,
            progress,
            started=arguments.started or started,
            restored=restored,
        )
        return _status(service.run(), spec)
    except (ValueError, SettingsError, TransportError) as error:  # another network's checkpoint, a rival
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


def _newest_checkpoint(directory: Path, progress: Progress) -> "Checkpoint | None":
    """What to go on from; None if the run ended before its first checkpoint. Raises DamagedError if none is whole."""
    if not checkpoints(directory):
        progress.say("there is no checkpoint yet: the run starts from its beginning")
        return None
    from learner.checkpoint import load_newest

    restored = load_newest(directory, progress.say)
    steps = restored.counters["env_steps"]
    progress.say(f"going on from checkpoint {restored.policy.policy_version} at {steps:,} env_steps")
    return restored


def _status(outcome: Outcome, spec: RunSpec) -> int:
    if not outcome.finished:
        return FAILED
    wanted = spec.training.target_return is not None and spec.training.stop_when_solved
    return NOT_REACHED if wanted and not outcome.solved else REACHED


if __name__ == "__main__":
    sys.exit(main())
