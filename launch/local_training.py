"""One run on this machine: training by supervised processes, then the evaluation of the result."""

import logging
import os
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from typing import Any

from daedalus.launch.child_output import ChildOutput, OpenStreams, inherited
from daedalus.launch.local_run import (
    LocalRun,
    RunEnd,
    RunFailedError,
    RunStoppedError,
    UnsavedError,
    actor_arguments,
    gateway_arguments,
    helper_log_words,
    learner_arguments,
    resume_command,
)
from daedalus.launch.process_lifecycle import FAILED, FINISHED, ORDERED, SUPERSEDED, UNSAVED
from daedalus.launch.supervision import (
    GATEWAY,
    INFERENCE,
    LEARNER_GRACE_SECONDS,
    Child,
    FailedError,
    Supervised,
    ask_to_end,
    evaluators,
    start,
    stop,
    supervised_actor,
    supervised_gateway,
    supervised_inference,
)
from daedalus.launch.tracker_processes import TrackerProcesses
from daedalus.learner.league.versions import VersionFolder
from daedalus.learner.run import run_directory
from daedalus.learner.run.run_directory import OPERATOR_TOKEN
from daedalus.learner.run.settings import SettingsError
from daedalus.learner.serving.events import EventFile
from daedalus.policy.saving.saved_policy import candidates
from daedalus.policy.user_modules import allow_settings
from daedalus.protocol.league import version_name
from daedalus.protocol.texts import one_line
from daedalus.transport.addresses import socket_path
from daedalus.transport.private_address import private_address
from daedalus.transport.process_usage import available_processors

_logger = logging.getLogger(__name__)

_POLL_SECONDS = 0.05
EVALUATOR = "evaluator"
_CONFIRMATION = "confirmation"
_HELPERS = {EVALUATOR, _CONFIRMATION, GATEWAY}  # processes without which a run goes on
_SUMMARY_SECONDS = 30.0  # for the learner to write its summary after a callback ended training


def train(
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

    def player(name: str, address: str, options: tuple[str, ...]) -> Supervised:
        return supervised_actor(name, address, options, output.pipes, output.last_error, run.start_player)

    with _observed_address(run) as address:
        spec, options = run.spec, actor_arguments(run)
        learner = supervised_learner(run, address, learner_streams)
        actors: list[Supervised] = []
        inference: list[Supervised] = []
        try:
            folder = os.path.dirname(socket_path(address) or "")
            inference, shared = supervised_inference(run.inference, folder, helper_log_words(run.logs), output.pipes)
            # One by one: if one cannot be started, those before it are stopped.
            for index in range(spec.collection.actors):
                actors.append(player(f"actor-{index}", address, (*options, *shared)))
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
                actors.append(player(EVALUATOR, address, (*options, "--evaluator")))
            if run.player_address is not None:
                waiting = (*options, "--evaluator", "--stay")
                actors.append(player(_CONFIRMATION, run.player_address, waiting))
            # Of a run that was killed, or of whoever has sent this directory: it must not count.
            (run.directory / OPERATOR_TOKEN).unlink(missing_ok=True)
            if run.watch:
                page.append(supervised_gateway(address, gateway_arguments(run), output.pipes))
            trackers.start()
            return watch(learner, [*actors, *inference, *page], run, stopping)
        finally:
            ask_to_end(learner.process)
            stop([actor.process for actor in actors], [each.process for each in inference])
            # Where the disk is slow, it takes longer than the others.
            stop([learner.process], grace_seconds=LEARNER_GRACE_SECONDS)


@contextmanager
def _observed_address(run: LocalRun) -> Iterator[str]:
    """Yield a private address for the learner. The observer of the run follows it there."""
    with private_address() as address:
        run.observer.begin(address)
        try:
            yield address
        finally:
            run.observer.end()


def supervised_learner(run: LocalRun, address: str, open_streams: OpenStreams, *, joins: bool = False) -> Supervised:
    """Start a learner. After a crash, the next process resumes from the newest checkpoint.

    `joins`: there is a router at the address, which several learners share.
    """
    descriptors = *run.lock, *run.observer.descriptors

    def begin(first: bool) -> Child:
        arguments = learner_arguments(run, address, first=first, joins=joins)
        with open_streams("learner") as streams:
            return start("daedalus.cli.commands.learner", *arguments, streams=streams, descriptors=descriptors)

    return Supervised("the learner", begin, ended=FINISHED | {ORDERED, UNSAVED, SUPERSEDED})


def _end(learner: Child, stopping: threading.Event) -> None:
    """End the learner, and wait until it has written its summary, which the evaluation reads."""
    ask_to_end(learner)
    deadline = time.monotonic() + _SUMMARY_SECONDS
    while learner.poll() is None and time.monotonic() < deadline and not stopping.wait(_POLL_SECONDS):
        pass


def watch(learner: Supervised, actors: list[Supervised], run: LocalRun, stopping: threading.Event) -> int:
    """Wait for the end of the learner, restart processes that die, and return the learner's exit status.

    The log shows each restart, and events.jsonl keeps it. Return 0 if the observer ends training, or UNSAVED. Raises
    FailedError if the learner failed too often, or if too few actors are left.
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
        for actor in list(actors):
            try:
                _warn(actor.check(), record)
            except FailedError as error:
                actors.remove(actor)
                stop([actor.process])
                playing = sum(other.name not in {*_HELPERS, INFERENCE} for other in actors)
                # A synchronous algorithm waits for all actors at its start.
                needed = not playing or run.spec.algorithm.synchronous or actor.name == INFERENCE
                if needed and actor.name not in _HELPERS:
                    _end(learner.process, stopping)
                    if learner.process.returncode in FINISHED:  # it had all env_steps that it needs
                        return learner.process.returncode
                    raise (error if playing else FailedError("all actors", error.reason, "failed")) from None
                _warn(f"{error}; training continues without this process", record)
    return 1


def _warn(message: str | None, record: EventFile) -> None:
    if message:
        _logger.warning("%s", message)
        record.add_restart(message)


def _keep(page: Sequence[Supervised], stopping: threading.Event) -> None:
    """Wait until the user stops the page, or until it has ended."""
    while any(gateway.process.poll() is None for gateway in page) and not stopping.wait(_POLL_SECONDS):
        pass


def run_locally(
    run: LocalRun,
    stopping: threading.Event,
    output: ChildOutput,
    learner_streams: OpenStreams = inherited,
    on_end: Callable[[RunEnd], None] = lambda end: None,
) -> RunEnd:
    """Train until the target or the end of the budget, then evaluate the best checkpoint.

    No child process is left when this returns or raises.

    Args:
      run: what to run.
      stopping: ends the run early when it is set.
      output: reads what the actors and the evaluations write.
      learner_streams: where the learner writes its log and its progress.
      on_end: called with the result, while the page still shows the run.

    Raises RunFailedError or RunStoppedError.
    """
    page: list[Supervised] = []
    trackers = TrackerProcesses(run.log, run.directory, output, log_json=run.logs.as_json)
    try:
        try:
            if run.trained is None:
                status = train(run, stopping, output, learner_streams, page, trackers)
            else:
                trackers.start()
                status = run.trained
            if stopping.is_set():
                raise RunStoppedError
            if status == ORDERED:
                raise RunStoppedError(stopped_by(run))
            if status == UNSAVED:
                raise UnsavedError(f"the last checkpoint could not be saved, so the run has no result: {_remedy(run)}")
            if status not in FINISHED:
                raise RunFailedError(status=status)
            end = RunEnd(status=status, summary=evaluate_run(run, stopping, output, learner_streams))
        except KeyboardInterrupt:  # in a function of the public API: trackers have little time then
            stopping.set()
            raise
        finally:
            trackers.finish(stopping)
        on_end(end)
        if run.keeps_page:
            _keep(page, stopping)
        return end
    except FailedError as error:
        if stopping.is_set():
            raise RunStoppedError from None
        raise RunFailedError(str(error)) from None
    except KeyboardInterrupt:  # in a function of the public API
        stopping.set()
        raise
    finally:
        stop([gateway.process for gateway in page])  # until now it has shown the result
        if run.watch:
            with suppress(OSError):
                (run.directory / run_directory.OPERATOR_TOKEN).unlink()


def stopped_by(run: LocalRun) -> str:
    """Return which operator stopped a run, or an empty text."""
    with suppress(SettingsError):  # missing or damaged
        return one_line(str(run_directory.read_json(run.directory / run_directory.SUMMARY).get("stopped_by") or ""))
    return ""


def _remedy(run: LocalRun) -> str:
    return f"make room on the disk, or make it writable, then type: {resume_command(run)}"


def _final_opponents(run: LocalRun) -> list[str]:
    """Return the opponents of the final evaluation of a policy that plays itself; empty for any other run.

    They are the fixed ones, or else the oldest version that the league has kept.
    """
    if not run.spec.environment.is_game:
        return []
    kept = [each.policy_version for each in VersionFolder(run.directory / run_directory.LEAGUE).versions()]
    return (list(run.spec.league.opponents) or [version_name(min(kept))]) if kept else []


def evaluate_run(
    run: LocalRun, stopping: threading.Event, output: ChildOutput, open_streams: OpenStreams = inherited
) -> dict[str, Any]:
    """Select the best checkpoint, play the final episodes with it, and return the summary with the results.

    A process offers the policies, and evaluators play: for several candidates several at a time. A run without final
    episodes keeps the summary of its training.

    Args:
      run: which has been trained.
      stopping: ends the evaluations early when it is set.
      output: reads what the evaluators print. It shows the progress of the first one.
      open_streams: where the process that offers the policies writes its log.

    Raises RunStoppedError, RunFailedError, and UnsavedError on a full disk.
    """
    if not (run.directory / run_directory.SUMMARY).exists():  # the learner has said why
        raise UnsavedError(f"the summary of the run could not be saved: {_remedy(run)}")
    if run.spec.evaluation.final_episodes == 0:
        return run_directory.read_json(run.directory / run_directory.SUMMARY)
    most = min(len(candidates(run.directory)) or 1, available_processors())
    opponents = _final_opponents(run)
    names = [] if opponents else [f"evaluation-{number}" for number in range(most)]
    options = *helper_log_words(run.logs), *allow_settings(run.spec.environment.user_modules)
    with private_address() as address:
        with open_streams("evaluation") as streams:
            # It plays games against opponents itself.
            games = [*allow_settings(run.spec.actor_modules), *(f"--against={name}" for name in opponents)]
            arguments = (str(run.directory), address, *run.logs.words(), *(games if opponents else ()))
            host = start("daedalus.launch.final_evaluation", *arguments, streams=streams, descriptors=run.lock)
        try:
            with evaluators(address, names, options, output, run.start_player) as failure:
                while host.poll() is None:
                    if stopping.wait(_POLL_SECONDS):
                        raise RunStoppedError
                    if reason := failure():
                        raise RunFailedError(reason)
        finally:
            stop([host])
    if host.returncode and stopping.is_set():  # it was stopped as well
        raise RunStoppedError
    if host.returncode == UNSAVED:
        raise UnsavedError(_remedy(run))
    if host.returncode:
        how = f"the process of the evaluation ended with status {host.returncode}"
        raise RunFailedError("" if host.returncode == FAILED else how)  # it has printed the reason
    return run_directory.read_json(run.directory / run_directory.SUMMARY)
