"""Function `run_locally`: training, then the evaluation of the result. What went wrong becomes one of three errors."""

import threading
from contextlib import suppress
from typing import Any

from daedalus.cli.child_output import ChildOutput, OpenStreams, inherited
from daedalus.cli.evaluation_processes import EvaluationFailedError
from daedalus.cli.processes import ORDERED, UNSAVED, UNWRITABLE
from daedalus.cli.running.final_evaluation import evaluate_run
from daedalus.cli.running.local_run import (
    LocalRun,
    RunEnd,
    RunFailedError,
    RunStoppedError,
    UnsavedError,
    resume_command,
)
from daedalus.cli.running.training import FINISHED, train
from daedalus.cli.supervisor import FailedError, Supervised, stop
from daedalus.cli.tracking.tracker_processes import TrackerProcesses
from daedalus.learner.run import run_directory


def run_locally(
    run: LocalRun, stopping: threading.Event, output: ChildOutput, learner_streams: OpenStreams = inherited
) -> RunEnd:
    """Train until the target or the end of the budget, then evaluate the best checkpoint.

    No child process is left when this returns or raises.

    Args:
      run: what to run.
      stopping: ends the run early when it is set.
      output: reads what the actors and the evaluations write.
      learner_streams: where the learner writes its log and its progress.

    Raises RunFailedError or RunStoppedError.
    """
    page: list[Supervised] = []
    trackers = TrackerProcesses(run.log, run.directory, output, log_json=run.log_json)
    try:
        if run.trained is None:
            status = train(run, stopping, output, learner_streams, page, trackers)
        else:
            trackers.start()
            status = run.trained
        if stopping.is_set() or status == ORDERED:
            raise RunStoppedError
        if status == UNSAVED:
            raise UnsavedError(f"the last checkpoint could not be saved, so the run has no result: {_remedy(run)}")
        if status not in FINISHED:
            raise RunFailedError(status=status)
        return RunEnd(status=status, summary=_evaluated(run, stopping, output))
    except (FailedError, EvaluationFailedError) as error:
        if stopping.is_set():
            raise RunStoppedError from None
        raise RunFailedError(str(error)) from None
    except KeyboardInterrupt:  # in a function of the public API
        stopping.set()
        raise
    finally:
        stop([gateway.process for gateway in page])  # until now it has shown the result
        trackers.finish(stopping)
        if run.watch:
            with suppress(OSError):
                (run.directory / run_directory.OPERATOR_TOKEN).unlink()


def _remedy(run: LocalRun) -> str:
    return f"make room on the disk, or make it writable, then type: {resume_command(run)}"


def _evaluated(run: LocalRun, stopping: threading.Event, output: ChildOutput) -> dict[str, Any]:
    """Return the summary with the evaluation. Raises UnsavedError on a full disk, and EvaluationFailedError."""
    if not (run.directory / run_directory.SUMMARY).exists():  # the learner has said why
        raise UnsavedError(f"the summary of the run could not be saved: {_remedy(run)}")
    try:
        return evaluate_run(run, stopping, output)
    except OSError as error:
        if error.errno not in UNWRITABLE:
            raise
        raise UnsavedError(f"the evaluation could not be saved: {error.strerror}: {_remedy(run)}") from None
