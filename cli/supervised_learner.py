"""Supervision of a learner of several processes that `daedalus learner` starts: it restarts from its checkpoint."""

import argparse
import logging
import subprocess
import sys
import threading
from contextlib import suppress
from pathlib import Path

from daedalus.launch.child_output import inherited
from daedalus.launch.logs import configure_logging, print_error
from daedalus.launch.process_lifecycle import SUPERSEDED, UNSAVED
from daedalus.launch.supervision import LEARNER_GRACE_SECONDS, FailedError, Supervised, start, stop
from daedalus.learner.run import run_directory
from daedalus.learner.run.settings import SettingsError

_logger = logging.getLogger(__name__)

_POLL_SECONDS = 0.05
_ENDED = {0, 3, UNSAVED, SUPERSEDED}  # exit statuses of a learner that is not restarted
_FAILED = 1


def supervise_learner(directory: Path, arguments: argparse.Namespace, stopping: threading.Event) -> int:
    """Run the command line of this process again as a child process, and return its exit status.

    If a process of the learner dies, all of them end, and the learner continues from its newest checkpoint.

    Args:
      directory: of the run; it is new, unless `arguments` name it.
      arguments: of this process.
      stopping: ends the learner.

    Raises SettingsError if the directory cannot be created.
    """
    configure_logging(arguments.log_level, as_json=arguments.log_json, process="learner")
    numbered = arguments.run_dir is None
    if numbered:
        try:
            directory = run_directory.make_numbered(directory)
        except OSError as error:
            raise SettingsError(f"run directory {directory}: {error.strerror}") from None

    def begin(first: bool) -> subprocess.Popen[bytes]:
        given = [word for word in sys.argv[1:] if first or word != "--reset-statistics"]
        options = [*given, "--run-dir", str(directory), *([] if first else ["--resume"])]
        with inherited("learner") as streams:
            return start("daedalus.cli.commands.learner", *options, streams=streams)

    learner = Supervised("the learner", begin, ended=_ENDED)
    try:
        status = _watched(learner, stopping)
        return _FAILED if status == UNSAVED else status
    except FailedError as error:
        print_error("learner", error)
        return _FAILED
    finally:
        stop([learner.process], LEARNER_GRACE_SECONDS)
        if numbered:
            with suppress(OSError):  # not empty
                directory.rmdir()


def _watched(learner: Supervised, stopping: threading.Event) -> int:
    """Restart the learner while it dies, and return its last exit status. Raises FailedError."""
    while not stopping.wait(_POLL_SECONDS):
        status = learner.process.poll()
        if status is not None and (status in learner.ended or learner.failed_at_once):
            return status
        if message := learner.check():
            _logger.warning("%s", message)
    stop([learner.process], LEARNER_GRACE_SECONDS)
    status = learner.process.returncode
    return status if status >= 0 else _FAILED
