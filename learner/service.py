"""The learner process: from the first actor that joins to the last checkpoint.

This is the main thread; the other threads are those of the actor server and the recorder. Torch is imported after
actors can join, because the import takes a second and the actors make their environments in the meantime.
"""

import gc
import logging
import sys
import time
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from daedalus.learner.reporting.progress import Progress
from daedalus.learner.reporting.recorder import OpenWriter, Recorder
from daedalus.learner.reporting.run_reporter import RunReporter, continue_records
from daedalus.learner.reporting.user_metrics import UserMetrics
from daedalus.learner.run.heartbeat import Heartbeat
from daedalus.learner.run.resuming import NO_WEIGHTS, Beginning
from daedalus.learner.run.run_directory import accept_config
from daedalus.learner.run.settings import DeviceLostError, check_rollout_length, unmeasured_target
from daedalus.learner.serving.actor_server import ActorServer
from daedalus.learner.serving.events import STOPPED_BY, EventFile
from daedalus.learner.serving.run_context import RunContext
from daedalus.learner.target_confirmation import Player, TargetConfirmation
from daedalus.policy.user_code import shown_path
from daedalus.protocol.messages import RunStatus
from daedalus.transport.interface import Transport

if TYPE_CHECKING:
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
    stopped_by: str = ""  # the operator who stopped the run; empty if none did
    superseded_by: int | None = None  # epoch of a newer learner of this run, for which this one stepped down


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Outputs:
    """Where the metrics of a run go, and the metrics that its program adds."""

    progress: Progress  # shows each metrics row
    writers: Sequence[OpenWriter] = ()
    user_metrics: UserMetrics = field(default_factory=UserMetrics)


class LearnerService:
    """One run of one learner process over one transport."""

    def __init__(
        self,
        context: RunContext,
        transport: Transport,
        outputs: Outputs,
        beginning: Beginning = NO_WEIGHTS,
        *,
        open_player: Callable[[], AbstractContextManager[Player]] | None = None,
    ) -> None:
        """Construct the service.

        Args:
          context: the run, which it begins or continues.
          transport: the network; the caller closes it.
          outputs: where the metrics of the run go.
          beginning: what the policy begins with.
          open_player: see TargetConfirmation; None: the newest returns decide alone that the target is reached.
        """
        self._context, self._outputs, self._beginning = context, outputs, beginning
        self._heartbeat = Heartbeat(context.directory)
        self._server = ActorServer(context, transport, self._status)
        self._episodes, self._cloned = None, False
        if open_player is not None:
            beat = self._heartbeat.beat
            self._episodes = TargetConfirmation(context, self._server.publisher, open_player, beat)
        self._confirmation = self._episodes if context.spec.training.stop_when_solved else None
        self._reporter = RunReporter(context, outputs.user_metrics)

    def run(self) -> Outcome:
        """Serve actors and train until the target is reached, the budget is used or the stop event is set.

        Once training has begun, the run always ends with a checkpoint and a summary. Raises TransportError if another
        learner serves the run, CheckpointMismatchError if a checkpoint does not fit the settings, NetworkError if
        the policy or the algorithm does not support the spaces, SettingsError if the device is not available,
        rollouts are too short for masked actions or demonstrations do not fit, DamagedError for damaged ones.
        """
        self._heartbeat.start()
        league = self._context.league
        try:
            if league is not None:
                league.load_opponents()
            self._server.open()
            continue_records(self._context)
            if league is not None:
                league.open(self._context.start_version)
            pauses = "torch" not in sys.modules and gc.isenabled()
            if pauses:  # the collector would look through all of torch, again and again, also at the end
                gc.disable()
            from daedalus.learner.training.learner import Learner
            from daedalus.learner.training.replay_learner import ReplayLearner

            if pauses:
                gc.freeze()
                gc.enable()
            if self._context.fleet.spaces is None and not self._server.await_actor(self._heartbeat.beat):
                return self._stopped_early("before the first actor joined")
            spaces = self._context.fleet.spaces
            assert spaces is not None
            spec = self._context.spec
            check_rollout_length(spec, spaces)
            if league is not None:
                league.check_opponents(spaces)
            if spec.algorithm.replay:
                learner: Learner = ReplayLearner(spec, spaces, self._beginning.modules)
            else:
                learner = Learner(spec.training, spec.policy, spaces, self._beginning.modules)
            self._beginning.load_into(learner, spec, self._context.progress)
            if not self._read_demonstrations(learner):
                return self._stopped_early("before the first update")
            checkpointer, loop = self._training_of(learner)
            if self._beginning.initial is not None:
                checkpointer.begin()  # a learner that is killed before its first checkpoint continues from this one
            if self._beginning.restored is None and not self._server.await_actor(self._heartbeat.beat):
                return self._stopped_early("before the first actor joined")
            if self._cloned and self._episodes is not None:
                self._episodes.evaluate_cloned(learner)
            accept_config(self._context.directory)
            return self._learn(learner, checkpointer, loop)
        finally:
            self._server.close(self._why_stopped)  # unless it is closed
            self._heartbeat.clear()

    def _read_demonstrations(self, learner: "Learner") -> bool:
        """Let the learner have its demonstrations, and imitate them. Return False if the run is stopped meanwhile."""
        from daedalus.learner.training.demonstrations import read_demonstrations
        from daedalus.learner.training.replay_learner import ReplayLearner

        taken = learner.replay.nbytes if isinstance(learner, ReplayLearner) else 0
        directory, spec = self._context.directory, self._context.spec
        demonstrations = read_demonstrations(directory, spec, learner.spaces, taken, self._heartbeat.beat)
        if demonstrations is None:
            return True
        learner.learn_from(demonstrations)
        if self._beginning.restored is not None:
            return True
        if result := learner.clone(self._goes_on):
            self._cloned = True
            _logger.info("behaviour cloning: %d updates; %s", spec.training.cloning_updates, result)
        return not self._context.stop.is_set()

    def _goes_on(self) -> bool:
        self._heartbeat.beat()
        return not self._context.stop.is_set()

    def _stopped_early(self, when: str) -> Outcome:
        _logger.info("stopped %s", when)
        self._server.close(self._why_stopped)
        if self._server.orders.stopped_by:  # else nothing has happened that anybody looks for
            EventFile(self._context.directory).add(self._context.events.take_new())
        self._server.orders.take_checkpoint()(True, f"stopped {when}: there is nothing to save")
        return self._outcome(finished=False, saved=True)

    def _training_of(self, learner: "Learner") -> "tuple[Checkpointer, TrainingLoop]":
        """Publish the policy. Return its checkpointer and its training loop."""
        from daedalus.learner.training.checkpointer import Checkpointer
        from daedalus.learner.training_loop import TrainingLoop

        program = learner.program()
        checkpointer = Checkpointer(self._context, learner, program, *self._replay_saves(learner))
        loop = TrainingLoop(
            self._context, self._server, learner, checkpointer, self._confirmation, self._heartbeat.beat
        )
        loop.publish(program)
        return checkpointer, loop

    def _replay_saves(self, learner: "Learner") -> "tuple[Callable[[], Callable[[], None]], ...]":
        """Load the replay buffer of a resumed run, and return what saves it; empty where there is nothing to save."""
        from daedalus.learner.training.replay_files import ReplayFiles
        from daedalus.learner.training.replay_learner import ReplayLearner

        if not (isinstance(learner, ReplayLearner) and self._context.spec.training.replay_saved):
            return ()
        files = ReplayFiles(self._context.directory, learner)
        files.load(self._heartbeat.beat)
        return (files.begin,)

    def _learn(self, learner: "Learner", checkpointer: "Checkpointer", loop: "TrainingLoop") -> Outcome:
        """Train, then write the last metrics row, checkpoint and summary, and let the actors leave."""
        context, server, reporter = self._context, self._server, self._reporter
        if problem := unmeasured_target(context.spec):
            _logger.warning("%s", problem)
        event_file = EventFile(context.directory)
        outputs = self._outputs
        recorder = Recorder(outputs.writers, outputs.progress, lambda: event_file.add(context.events.take_new()))
        reporter.begin(recorder, time.monotonic())
        finished, ended, saving, saved, lost = False, None, None, False, False
        from daedalus.learner.training.update_graphs import driver_faults

        try:
            with driver_faults():
                ended = loop.run(reporter)
            finished = context.is_finished
        except DeviceLostError:
            lost = True
            raise
        finally:
            trained, ended = ended is not None, ended or time.monotonic()
            try:
                server.close(_FINISHED if finished else self._why_stopped, finished=finished)
                if trained:
                    loop.keep_received()
                if not lost:
                    saving = checkpointer.begin(last=True)  # it is written while the last metrics are
                    reporter.record(learner, ended, last=True)
                reporter.close()
            finally:
                result = "the checkpoint is not saved: the GPU has failed"
                if not lost:
                    saving = saving or checkpointer.begin(last=True)
                    saved = checkpointer.wait(saving, self._heartbeat.beat)
                    result = saving.result or "the checkpoint is not saved: the disk is slow"
                server.orders.take_checkpoint()(saved, result)
        assert saving is not None
        confirmation = self._confirmation.result if self._confirmation is not None else None
        if saving.done.is_set():  # else the disk does not answer
            stopped_by = "" if finished else server.orders.stop_cause
            reporter.write_summary(finished=finished, stopped_by=stopped_by, ended=ended, confirmation=confirmation)
        env_steps = f"{context.counters.env_steps:,} env_steps"
        if finished:
            server.await_departures()
        elif saved:
            _logger.info("stopped; checkpoint saved at %s: %s", env_steps, shown_path(str(saving.directory)))
        return self._outcome(finished=finished, saved=saved)

    def _outcome(self, *, finished: bool, saved: bool) -> Outcome:
        return Outcome(
            solved=self._context.counters.seconds_to_target is not None,
            finished=finished,
            saved=saved,
            stopped_by=self._server.orders.stopped_by,
            superseded_by=self._server.orders.superseded_by,
        )

    @property
    def _why_stopped(self) -> str:
        """The reason for actors and for the events, if the run is stopped."""
        author = self._server.orders.stopped_by
        return f"{STOPPED_BY}{author}" if author else _STOPPED

    def _status(self) -> RunStatus:
        status = self._reporter.status(self._server.rollouts.queue_bytes, time.monotonic())
        return status.model_copy(update={"last_order": self._server.orders.last})
