"""One run on this machine: a learner and actors as child processes, supervised to their end, then the evaluation.

`daedalus train`, `daedalus resume` and `daedalus.train` share this file.
"""

import logging
import socket
import subprocess
import threading
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from daedalus.cli.child_output import INHERITED, Streams
from daedalus.cli.select_best import EvaluationFailedError, play, select_best
from daedalus.cli.supervisor import FailedError, Supervised, start, stop, supervised_actor
from daedalus.learner.run import run_directory
from daedalus.protocol.spec import RunSpec

_logger = logging.getLogger(__name__)

_POLL_SECONDS = 0.05
_EVALUATOR = "evaluator"
_FINISHED = {0, 3}  # exit statuses of a learner: see RunEnd


class RunFailedError(Exception):
    """A run that did not finish; the message is empty where a child process has printed the reason."""

    def __init__(self, message: str = "", status: int = 1) -> None:
        super().__init__(message)
        self.status = status  # exit status for the command


class RunStoppedError(Exception):
    """A run that was stopped before its end."""


@dataclass(frozen=True, slots=True, kw_only=True)
class LocalRun:
    """A run whose directory and config.toml exist already, and where more actors may join."""

    directory: Path
    spec: RunSpec
    started: float  # monotonic clock; the run's seconds count from there
    resume: bool = False
    listen: str | None = None  # beside a free port of this machine
    tls: Path | None = None
    insecure: bool = False
    wrap: str | None = None  # module:function, for this machine's environments


@dataclass(frozen=True, slots=True, kw_only=True)
class RunEnd:
    """How a run ended."""

    status: int  # 0 the target was reached or the asked-for steps were done, 3 the budget ended without the target
    summary: dict[str, Any]  # summary.json, with the evaluation


def run_locally(run: LocalRun, stopping: threading.Event, streams: Streams = INHERITED) -> RunEnd:
    """Train until the target or the end of the budget, then evaluate the best checkpoint.

    No child process is left when this returns or raises.

    Args:
      run: what to run.
      stopping: ends the run early when it is set.
      streams: where the child processes write.

    Raises RunFailedError or RunStoppedError.
    """
    try:
        status = _train(run, stopping, streams)
        if stopping.is_set():
            raise RunStoppedError
        if status not in _FINISHED:
            raise RunFailedError(status=status)
        return RunEnd(status=status, summary=evaluate_run(run, stopping, streams))
    except (FailedError, EvaluationFailedError) as error:
        if stopping.is_set():
            raise RunStoppedError from None
        raise RunFailedError(str(error)) from None


def _train(run: LocalRun, stopping: threading.Event, streams: Streams) -> int:
    """Run the learner and the actors; return the learner's exit status. Raises FailedError."""
    spec, options = run.spec, ("--wrap", run.wrap) if run.wrap else ()
    listening, address = _addresses(run)
    learner = _supervised_learner(run, listening, streams)
    actors: list[Supervised] = []
    try:
        names = [f"actor-{index}" for index in range(spec.collection.actors)]
        actors += [supervised_actor(name, address, options, streams) for name in names]
        training = spec.training
        _logger.info(
            f"{spec.environment.id}: {training.algorithm}, seed {training.seed}, {len(actors)} actors"
            f" x {spec.collection.envs_per_actor} environments at {address}; run directory {run.directory}"
        )
        if spec.evaluation.seconds is not None:
            actors.append(supervised_actor(_EVALUATOR, address, (*options, "--evaluator"), streams))
        return watch(learner, actors, spec, stopping)
    finally:
        stop([learner.process, *(actor.process for actor in actors)])


def _addresses(run: LocalRun) -> tuple[list[str], str]:
    """Return the learner's options for listening, and the address for this machine's actors, which use no TLS."""
    own = f"tcp/127.0.0.1:{_free_port()}" if run.listen is None or run.tls else run.listen
    addresses = [own] if run.listen in (None, own) else [own, run.listen]
    listening = [word for address in addresses for word in ("--listen", address)]
    if run.tls:
        listening += ["--tls", str(run.tls)]
    return [*listening, *(["--insecure"] if run.insecure else [])], own


def _supervised_learner(run: LocalRun, listening: list[str], streams: Streams) -> Supervised:
    """Start a learner that resumes from its newest checkpoint if it is killed."""

    def begin(first: bool) -> subprocess.Popen[bytes]:
        since = run.started if first else time.monotonic()
        arguments = ["--prepared", str(run.directory), *listening, "--started", repr(since)]
        resume = ["--resume"] if run.resume or not first else []
        return start("daedalus.cli.commands.learner", *arguments, *resume, streams=streams)

    return Supervised("the learner", begin, ended=_FINISHED)


def watch(learner: Supervised, actors: list[Supervised], spec: RunSpec, stopping: threading.Event) -> int:
    """Wait for the learner's end, restarting processes that die; return the learner's exit status.

    Raises FailedError if the learner failed for good, or too few actors are left.
    """
    while not stopping.wait(_POLL_SECONDS):
        status = learner.process.poll()
        if status is not None and (status in learner.ended or learner.failed_at_once):
            return status
        _warn(learner.check())
        for actor in list(actors):
            try:
                _warn(actor.check())
            except FailedError as error:
                actors.remove(actor)
                stop([actor.process])
                playing = sum(other.name != _EVALUATOR for other in actors)
                needed = not playing or spec.algorithm.synchronous  # a2c waits for all at its start
                if needed and actor.name != _EVALUATOR:
                    raise
                _warn(f"{error}; going on without it")
    return 1


def _warn(news: str | None) -> None:
    if news:
        _logger.warning(news)


def evaluate_run(run: LocalRun, stopping: threading.Event, streams: Streams = INHERITED) -> dict[str, Any]:
    """Select the best checkpoint, play the final episodes with it, and return the summary with the results.

    Raises EvaluationFailedError.
    """
    began = time.monotonic()
    options = ["--episodes", str(run.spec.evaluation.final_episodes), *(["--wrap", run.wrap] if run.wrap else [])]
    chosen = select_best(run.directory, run.spec, options, stopping, streams)
    (evaluation,) = play([[str(run.directory), *options]], stopping, streams)
    summary = run_directory.read_json(run.directory / run_directory.SUMMARY)
    summary["evaluation_return_mean"] = evaluation["return_mean"]
    summary["evaluation_return_std"] = evaluation["return_std"]
    summary["evaluation"] = {**evaluation, "select_best": chosen, "seconds": time.monotonic() - began}
    run_directory.write_json(run.directory / run_directory.SUMMARY, summary)
    return summary


def _free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]
