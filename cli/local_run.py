"""One run on this machine: a learner and actors as supervised child processes, then the evaluation of the result.

`daedalus train`, `daedalus resume` and `daedalus.train` share this file.
"""

import logging
import shlex
import subprocess
import threading
import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from daedalus.cli.child_output import ChildOutput, OpenStreams, inherited
from daedalus.cli.confirmation import Confirmations
from daedalus.cli.evaluation_processes import EvaluationFailedError, play, without_episodes
from daedalus.cli.processes import ORDERED, UNSAVED, UNWRITABLE
from daedalus.cli.run_observer import RunObserver
from daedalus.cli.sampled_evaluation import is_below_training, sampled_note
from daedalus.cli.select_best import select_best
from daedalus.cli.supervisor import (
    GATEWAY,
    FailedError,
    Supervised,
    start,
    stop,
    supervised_actor,
    supervised_gateway,
)
from daedalus.cli.tracking.tracker_processes import TrackerProcesses
from daedalus.learner.run import run_directory
from daedalus.learner.run.event_file import EventFile
from daedalus.policy.user_modules import allow_settings
from daedalus.protocol.spaces import Spaces
from daedalus.protocol.spec import RunSpec
from daedalus.transport.private_address import private_address

_logger = logging.getLogger(__name__)

_POLL_SECONDS = 0.05
_EVALUATOR = "evaluator"
_HELPERS = {_EVALUATOR, GATEWAY}  # processes without which a run goes on
_FINISHED = {0, 3}  # exit statuses of a learner: see RunEnd
_SUMMARY_SECONDS = 30.0  # for the learner to write its summary after a callback ended training


class RunFailedError(Exception):
    """Error of a run that did not finish. The message is empty if a child process has printed the reason."""

    def __init__(self, message: str = "", status: int = 1) -> None:
        super().__init__(message)
        self.status = status  # exit status for the command


class UnsavedError(RunFailedError):
    """Error of a run whose result could not be saved. The run can be resumed."""


class RunStoppedError(Exception):
    """Error of a run that was stopped before its end."""


@dataclass(frozen=True, slots=True, kw_only=True)
class LocalRun:
    """Settings of one run on this machine. Its directory and config.toml exist already.

    The processes import the modules that the specification names: the caller has checked that the user allows them.
    """

    directory: Path
    spec: RunSpec
    started: float  # on the monotonic clock; the seconds of the run count from this time
    lock: tuple[int, ...] = ()  # descriptor of the run's lock, which the learner inherits and holds as long as it lives
    resume: bool = False
    trained: int | None = None  # exit status of a run that is already trained and that only lacks its evaluation
    spaces: Spaces | None = None  # of the environment, if it was checked
    processes: int = 1  # of the learner
    init_from: Path | None = None  # another run, whose weights the learner begins with
    listen: str | None = None  # address for actors of other hosts, in addition to a private one of this machine
    tls: Path | None = None
    insecure: bool = False
    log_level: str = "info"  # of the learner and the evaluation; actors log warnings, or everything at "debug"
    log_json: bool = False
    watch: bool = False  # start a gateway with the page of the run
    camera: bool = True  # with a camera
    log: Sequence[str] = ()  # trackers that the run is logged to
    observer: RunObserver = field(default_factory=RunObserver)


@dataclass(frozen=True, slots=True, kw_only=True)
class RunEnd:
    """End of a run: exit status and summary."""

    status: int  # 0: target reached, or all steps done without a target to stop at; 3: budget used up before the target
    summary: dict[str, Any]  # summary.json, with the evaluation


def resume_command(run: LocalRun) -> str:
    """Return the command line that continues a run."""
    return shlex.join(["daedalus", "resume", str(run.directory), *allow_settings(run.spec.user_modules)])


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
            status = _train(run, stopping, output, learner_streams, page, trackers)
        else:
            trackers.start()
            status = run.trained
        if stopping.is_set() or status == ORDERED:
            raise RunStoppedError
        if status == UNSAVED:
            raise UnsavedError(f"the last checkpoint could not be saved, so the run has no result: {_remedy(run)}")
        if status not in _FINISHED:
            raise RunFailedError(status=status)
        return RunEnd(status=status, summary=_evaluated(run, stopping, output))
    except (FailedError, EvaluationFailedError) as error:
        if stopping.is_set():
            raise RunStoppedError from None
        raise RunFailedError(str(error)) from None
    finally:
        stop([gateway.process for gateway in page])  # until now it has shown the result
        trackers.finish(stopping)


def _remedy(run: LocalRun) -> str:
    return f"make room on the disk, then type: {resume_command(run)}"


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


def _train(
    run: LocalRun,
    stopping: threading.Event,
    output: ChildOutput,
    learner_streams: OpenStreams,
    page: list[Supervised],
    trackers: TrackerProcesses,
) -> int:
    """Run the learner and the actors; return the learner's exit status. Raises FailedError.

    Adds the gateway to `page`, and starts the trackers. The caller ends them.
    """
    with private_address() as address:
        run.observer.begin(address)
        try:
            return _train_at(address, run, stopping, output, learner_streams, page, trackers)
        finally:
            run.observer.end()


def _train_at(
    address: str,
    run: LocalRun,
    stopping: threading.Event,
    output: ChildOutput,
    learner_streams: OpenStreams,
    page: list[Supervised],
    trackers: TrackerProcesses,
) -> int:
    """Run the learner, and connect this machine's actors to it at an address."""
    spec, options = run.spec, _actor_options(run)
    listening = _listening(run, address)
    confirmations = Confirmations(run.directory, spec, _evaluation_options(run), output)
    learner = _supervised_learner(run, listening, learner_streams)
    actors: list[Supervised] = []
    try:
        for index in range(spec.collection.actors):  # one by one: if one cannot be started, those before it are stopped
            actors.append(supervised_actor(f"actor-{index}", address, options, output.pipes, output.last_error))
        training = spec.training
        _logger.info(
            "%s: %s, seed %d, %d actors x %d environments at %s; run directory %s",
            spec.environment.id,
            training.algorithm,
            training.seed,
            len(actors),
            spec.collection.envs_per_actor,
            address,
            run.directory,
        )
        if spec.evaluation.seconds is not None:
            evaluating = (*options, "--evaluator")
            actors.append(supervised_actor(_EVALUATOR, address, evaluating, output.pipes, output.last_error))
        if run.watch:
            page.append(supervised_gateway(address, _gateway_options(run), output.pipes))
        trackers.start()
        return watch(learner, [*actors, *page], run, stopping, confirmations)
    finally:
        stop([learner.process, *(actor.process for actor in actors), *confirmations.processes])
        confirmations.close()


def _logging_options(level: str, as_json: bool) -> tuple[str, ...]:
    return "--log-level", level, *(["--log-json"] if as_json else [])


def _actor_options(run: LocalRun) -> tuple[str, ...]:
    """Return the options of this machine's actors and of the evaluator."""
    # The learner reports the progress of all actors: the records of each one are for debugging.
    level = "debug" if run.log_level == "debug" else "warning"
    return *_logging_options(level, run.log_json), *allow_settings(run.spec.actor_modules)


def _evaluation_options(run: LocalRun) -> list[str]:
    """Return the options of every `daedalus evaluate`."""
    return [*_logging_options(run.log_level, run.log_json), *allow_settings(run.spec.environment.user_modules)]


def _gateway_options(run: LocalRun) -> tuple[str, ...]:
    """Return the options of the gateway with the page."""
    level = "debug" if run.log_level == "debug" else "warning"  # it prints its address at any level
    filming = [*allow_settings(run.spec.user_modules), "--checkpoints", str(run.directory)]
    camera = filming if run.camera else ["--no-camera"]
    token = ("--operator-token", str(run.directory / run_directory.OPERATOR_TOKEN))
    return *_logging_options(level, run.log_json), *token, *camera


def _listening(run: LocalRun, own: str) -> list[str]:
    """Return the learner's options for listening, at its own address and at that for actors of other hosts."""
    addresses = [own, run.listen] if run.listen else [own]
    listening = [word for address in addresses for word in ("--listen", address)]
    if run.tls:
        listening += ["--tls", str(run.tls)]
    return [*listening, *(["--insecure"] if run.insecure else [])]


def _supervised_learner(run: LocalRun, listening: list[str], open_streams: OpenStreams) -> Supervised:
    """Start a learner. After a crash, the next process resumes from the newest checkpoint."""
    descriptors = *run.lock, *run.observer.descriptors

    def begin(first: bool) -> subprocess.Popen[bytes]:
        since = run.started if first else time.monotonic()
        arguments = ["--prepared", str(run.directory), *listening, "--started", repr(since)]
        arguments += [*_logging_options(run.log_level, run.log_json), *run.observer.learner_options]
        arguments += allow_settings(run.spec.learner_modules)
        if run.spaces is not None:
            arguments += ["--spaces", run.spaces.model_dump_json()]
        if run.processes > 1:
            arguments += ["--processes", str(run.processes)]
        if run.init_from is not None:
            arguments += ["--init-from", str(run.init_from)]
        if run.spec.training.target_return is not None:
            arguments.append("--confirm")
        if run.resume or not first:
            arguments.append("--resume")
        with open_streams("learner") as streams:
            return start("daedalus.cli.commands.learner", *arguments, streams=streams, descriptors=descriptors)

    return Supervised("the learner", begin, ended=_FINISHED | {ORDERED, UNSAVED})


def _end(learner: subprocess.Popen[bytes], stopping: threading.Event) -> None:
    """End the learner, and wait until it has written its summary, which the evaluation reads."""
    learner.terminate()
    deadline = time.monotonic() + _SUMMARY_SECONDS
    while learner.poll() is None and time.monotonic() < deadline and not stopping.wait(_POLL_SECONDS):
        pass


def watch(
    learner: Supervised,
    actors: list[Supervised],
    run: LocalRun,
    stopping: threading.Event,
    confirmations: Confirmations,
) -> int:
    """Wait for the end of the learner, restart processes that die, and return the learner's exit status.

    The log shows each restart, and events.jsonl keeps it. Return 0 if the observer ends training, or UNSAVED. Raises
    FailedError if the learner failed too often, or if too few actors are left; EvaluationFailedError if the result of a
    confirmation cannot be saved.
    """
    record = EventFile(run.directory)
    while not stopping.wait(_POLL_SECONDS):
        status = learner.process.poll()
        if run.observer.poll(learner.process) and status is None:
            _end(learner.process, stopping)
            return UNSAVED if learner.process.returncode == UNSAVED else 0
        if status is not None and (status in learner.ended or learner.failed_at_once):
            return status
        _warn(learner.check(), record)
        confirmations.poll()
        for actor in list(actors):
            try:
                _warn(actor.check(), record)
            except FailedError as error:
                actors.remove(actor)
                stop([actor.process])
                playing = sum(other.name not in _HELPERS for other in actors)
                # A synchronous algorithm waits for all actors at its start.
                needed = not playing or run.spec.algorithm.synchronous
                if needed and actor.name not in _HELPERS:
                    raise (error if playing else FailedError("all actors", error.reason, "failed")) from None
                _warn(f"{error}; training continues without this process", record)
    return 1


def _warn(message: str | None, record: EventFile) -> None:
    if message:
        _logger.warning("%s", message)
        record.add_restart(message)


def evaluate_run(run: LocalRun, stopping: threading.Event, output: ChildOutput) -> dict[str, Any]:
    """Select the best checkpoint, play the final episodes with it, and return the summary with the results.

    If greedy episodes are clearly worse than training was, the same episodes are played with sampled actions, too,
    unless the policy is greedy anyway, or sampled episodes have confirmed the target. Raises EvaluationFailedError.
    """
    began = time.monotonic()
    summary = run_directory.read_json(run.directory / run_directory.SUMMARY)
    options = ["--episodes", str(run.spec.evaluation.final_episodes), *_evaluation_options(run)]
    chosen = select_best(run.directory, run.spec, options, stopping, output)
    (evaluation,) = play([[str(run.directory), *options]], stopping, output)
    confirmed = summary.get("confirmation") is not None  # by sampled episodes
    can_differ = run.spec.algorithm.heads == "policy_and_value"  # the policy of action values is always greedy
    if not confirmed and can_differ and is_below_training(evaluation, summary.get("episode_return_mean")):
        (sampled,) = play([[str(run.directory), *options, "--actions", "sampled"]], stopping, output)
        evaluation["notes"].append(sampled_note(evaluation, sampled))
        summary["sampled_evaluation"] = without_episodes(sampled)
    summary["evaluation_return_mean"] = evaluation["return_mean"]
    summary["evaluation_return_std"] = evaluation["return_std"]
    seconds = time.monotonic() - began
    summary["evaluation"] = {**without_episodes(evaluation), "select_best": chosen, "seconds": seconds}
    run_directory.write_json(run.directory / run_directory.EVALUATION, evaluation)
    run_directory.write_json(run.directory / run_directory.SUMMARY, summary)
    return summary
