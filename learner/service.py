"""The learner process: from the first actor that joins to the last checkpoint.

This is the main thread; the other threads are those of the actor server and the recorder. Torch is imported after
actors can join, because the import takes a second and the actors make their environments in the meantime.
"""

import logging
import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from daedalus.learner.reporting.progress import Progress
from daedalus.learner.reporting.recorder import OpenWriter, Recorder
from daedalus.learner.reporting.run_reporter import RunRecords, RunReporter, continue_records
from daedalus.learner.reporting.user_metrics import UserMetrics
from daedalus.learner.run.heartbeat import Heartbeat
from daedalus.learner.run.resuming import CheckpointMismatchError, other_network, other_spaces
from daedalus.learner.run.run_state import RunState
from daedalus.learner.run.settings import check_rollout_length, unmeasured_target
from daedalus.learner.serving.actor_server import ActorServer
from daedalus.learner.serving.events import EventFile
from daedalus.learner.serving.query_responses import Orders
from daedalus.learner.target_confirmation import TargetConfirmation
from daedalus.policy.saving.saved_policy import SavedPolicy
from daedalus.policy.user_modules import NO_MODULES, UserModules, shown_path
from daedalus.protocol.messages import RunStatus
from daedalus.protocol.spaces import Spaces
from daedalus.protocol.spec import RunSpec
from daedalus.transport.interface import Transport

if TYPE_CHECKING:
    from daedalus.learner.training.checkpoint import Checkpoint
    from daedalus.learner.training.checkpointer import Checkpointer
    from daedalus.learner.training.learner import Learner
    from daedalus.learner.training_loop import TrainingLoop

_logger = logging.getLogger(__name__)

# Reasons for actors.
_FINISHED, _STOPPED = "the learner has finished", "the learner was stopped"


@dataclass(frozen=True, slots=True, kw_only=True)
class Outcome:
    """Result of a run."""

    solved: bool
    finished: bool  # solved or out of budget; False if the run was stopped before
    saved: bool  # whether the last checkpoint was saved, or there was nothing to save
    seconds_to_target: float | None  # seconds until the target return was reached; None if it was not
    ordered: bool = False  # whether an operator stopped the run
    superseded_by: int | None = None  # epoch of a newer learner of this run, for which this one stepped down


class LearnerService:
    """One run of one learner process over one transport."""

    def __init__(
        self,
        spec: RunSpec,
        directory: Path,
        transport: Transport,
        stop: threading.Event,
        progress: Progress,
        open_writers: Sequence[OpenWriter],
        *,
        started: float,
        restored: "Checkpoint | None" = None,
        initial: SavedPolicy | None = None,
        other_spaces: bool = False,
        spaces: Spaces | None = None,
        modules: UserModules = NO_MODULES,
        certificate_days_left: Callable[[], float | None] = lambda: None,
        user_metrics: UserMetrics | None = None,
        confirms: bool = False,
        reset_statistics: bool = False,
    ) -> None:
        """Construct the service.

        Args:
          spec: specification of the run.
          directory: the run directory; its name is the name of the run.
          transport: the network; the caller closes it.
          stop: event that ends the run.
          progress: shows each metrics row.
          open_writers: functions that open the metrics writers.
          started: start of the run on the monotonic clock, in seconds.
          restored: checkpoint to continue from.
          initial: policy of another run whose weights to begin with, unless there is a checkpoint to continue from.
          other_spaces: whether the spaces of `initial` may be others than those of this run.
          spaces: spaces that all actors must have, if they are known; those of a checkpoint have precedence.
          modules: modules that may be imported for the policy.
          certificate_days_left: function that returns the days until the certificate of this process expires.
          user_metrics: metrics of the program that started the run.
          confirms: whether a launcher plays new episodes to confirm that the target is reached.
          reset_statistics: whether to forget the running statistics of the checkpoint.
        """
        self._spec, self._stop, self._progress = spec, stop, progress
        self._open_writers, self._modules = open_writers, modules
        self._restored, self._initial = restored, initial if restored is None else None
        self._allows_other_spaces = other_spaces
        self._reset_statistics = reset_statistics
        starts_before = restored.counters.get("starts", 0) if restored is not None else 0
        self._state = RunState(directory, spec, started, certificate_days_left, starts_before)
        if restored is not None:
            self._state.restore(restored.counters, restored.policy.spec)
        self._heartbeat = Heartbeat(directory)
        self._orders = Orders(stop)
        self._server = server = ActorServer(
            self._state.name,
            spec,
            transport,
            self._state.counters,
            self._status,
            learner_epoch=self.learner_epoch,
            start_version=restored.policy.policy_version if restored else 0,
            spaces=restored.policy.spaces if restored else spaces,
            orders=self._orders,
        )
        self._confirmation = None
        if confirms and spec.training.stop_when_solved:
            self._confirmation = TargetConfirmation(
                self._state, server.events, stop, lock=server.lock, beat=self._heartbeat.beat
            )
        self._reporter = RunReporter(self._state, server.fleet, server.lock, user_metrics or UserMetrics())

    @property
    def learner_epoch(self) -> int:
        """Epoch of this learner process."""
        return self._state.learner_epoch

    def run(self) -> Outcome:
        """Serve actors and train until the target is reached, the budget is used or the stop event is set.

        Once training has begun, the run always ends with a checkpoint and a summary. Raises TransportError if another
        learner serves the run, CheckpointMismatchError if a checkpoint does not fit the settings, NetworkError if
        the policy or the algorithm does not support the spaces, SettingsError if the device is not available or
        rollouts are too short for masked actions.
        """
        self._heartbeat.start()
        try:
            self._server.open()
            version = self._restored.policy.policy_version if self._restored is not None else 0
            continue_records(self._state, version, self._server.history, self._server.events)
            from daedalus.learner.training.learner import Learner

            if self._server.fleet.spaces is None and not self._await_actor():
                return self._stopped_without_actors()
            spaces = self._server.fleet.spaces
            assert spaces is not None
            check_rollout_length(self._spec, spaces)
            learner = Learner(self._spec.training, self._spec.policy, spaces, self._modules)
            self._load(learner, spaces)
            checkpointer, loop = self._training_of(learner, spaces)
            if self._initial is not None:
                checkpointer.begin()  # a learner that is killed before its first checkpoint continues from this one
            if self._restored is None and not self._await_actor():
                return self._stopped_without_actors()
            return self._learn(learner, checkpointer, loop)
        finally:
            self._server.close(_STOPPED)  # unless it is closed
            self._heartbeat.clear()

    def _await_actor(self) -> bool:
        """Wait until an actor has joined, and return whether one has; False if the run is stopped first."""
        return self._server.await_actor(self._stop, self._heartbeat.beat)

    def _stopped_without_actors(self) -> Outcome:
        _logger.info("stopped before the first actor joined")
        return Outcome(
            solved=False,
            finished=False,
            saved=True,
            seconds_to_target=None,
            ordered=self._orders.stopped,
            superseded_by=self._orders.superseded_by,
        )

    def _load(self, learner: "Learner", spaces: Spaces) -> None:
        """Begin with the weights of a checkpoint or of another run, if any. Raises CheckpointMismatchError."""
        if self._restored is not None:
            policy = self._restored.policy
            if difference := other_network(policy, self._spec.policy, spaces):
                raise CheckpointMismatchError(f"{policy.directory}: {difference}")
            learner.restore(policy.policy_version, policy.weights, self._restored.state)
            if self._reset_statistics:
                learner.reset_statistics()
                _logger.info("statistics of observations and rewards reset: the next rollouts define them")
            if learner.learning_rate(self._state.progress) == 0.0:
                _logger.warning(
                    "the learning rate has been annealed to 0: the policy changes no more; "
                    "start a new run from its weights, with --init-from"
                )
        elif self._initial is not None:
            try:
                self._check_initial(self._initial, spaces)
                learner.load(self._initial.weights)
            except CheckpointMismatchError as error:
                raise CheckpointMismatchError(f"--init-from {self._initial.directory}: {error}") from None
            version, directory = self._initial.policy_version, self._initial.directory
            _logger.info("initial weights: policy version %d of %s", version, directory)

    def _check_initial(self, initial: SavedPolicy, spaces: Spaces) -> None:
        """Raise CheckpointMismatchError if the policy of another run means something else in this one."""
        if difference := other_network(initial, self._spec.policy, spaces):
            raise CheckpointMismatchError(difference)
        difference = other_spaces(initial, self._spec.environment, spaces)
        if difference and not self._allows_other_spaces:
            raise CheckpointMismatchError(
                f"its policy is for other spaces: {difference}; name a run of the same spaces, or add "
                "--allow-other-spaces (in Python: allow_other_spaces=True) to load its weights if all shapes fit"
            )
        if difference:
            _logger.warning("initial weights of other spaces (--allow-other-spaces): %s", difference)

    def _training_of(self, learner: "Learner", spaces: Spaces) -> "tuple[Checkpointer, TrainingLoop]":
        """Publish the policy. Return its checkpointer and its training loop."""
        from daedalus.learner.training.checkpointer import Checkpointer
        from daedalus.learner.training_loop import TrainingLoop

        program, server = learner.program(), self._server
        checkpointer = Checkpointer(self._state, learner, program, spaces, events=server.events, lock=server.lock)
        loop = TrainingLoop(
            self._state,
            server,
            learner,
            checkpointer,
            orders=self._orders,
            confirmation=self._confirmation,
            stop=self._stop,
            beat=self._heartbeat.beat,
        )
        loop.publish(program)
        return checkpointer, loop

    def _learn(self, learner: "Learner", checkpointer: "Checkpointer", loop: "TrainingLoop") -> Outcome:
        """Train, then write the last metrics row, checkpoint and summary, and let the actors leave."""
        state, server = self._state, self._server
        if problem := unmeasured_target(self._spec):
            _logger.warning("%s", problem)
        event_file = EventFile(state.directory)
        recorder = Recorder(self._open_writers, self._progress, lambda: event_file.add(server.events.take_new()))
        records = RunRecords(state, self._reporter, server.history, recorder)
        self._reporter.begin(time.monotonic())
        finished, ended, saving = False, None, None
        try:
            ended = loop.run(records, resumed=self._restored is not None)
            finished = state.is_finished
        finally:
            ended = ended or time.monotonic()
            try:
                server.close(_FINISHED if finished else _STOPPED, finished=finished)
                saving = checkpointer.begin(last=True)  # it is written while the last metrics are
                records.record(learner, ended, last=True)
                records.close()
            finally:
                saving = saving or checkpointer.begin(last=True)
                saved = checkpointer.wait(saving, self._stop, self._heartbeat.beat)
        confirmation = self._confirmation.result if self._confirmation is not None else None
        if saving.done.is_set():  # else the disk does not answer
            records.write_summary(finished=finished, ended=ended, confirmation=confirmation)
        env_steps = f"{state.counters.env_steps:,} env_steps"
        if finished:
            server.await_departures(self._stop)
        elif saved:
            _logger.info("stopped; checkpoint saved at %s: %s", env_steps, shown_path(str(saving.directory)))
        return Outcome(
            solved=state.counters.seconds_to_target is not None,
            finished=finished,
            saved=saved,
            seconds_to_target=state.counters.seconds_to_target,
            ordered=self._orders.stopped,
            superseded_by=self._orders.superseded_by,
        )

    def _status(self) -> RunStatus:
        return self._reporter.status(self._server.rollouts.queue_bytes, time.monotonic())
