"""The learner process: serve actors, train on their rollouts, publish snapshots, save checkpoints.

This is the main thread; the other threads are those of the actor server and the recorder. Torch is imported after
actors can join, because the import takes a second and the actors make their environments in the meantime.
"""

import logging
import secrets
import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from daedalus.learner.ranks.errors import RankLostError
from daedalus.learner.ranks.opening import OpenRanks, one_process
from daedalus.learner.reporting.metrics_file import read_rows
from daedalus.learner.reporting.progress import Progress
from daedalus.learner.reporting.recorder import OpenWriter, Recorder
from daedalus.learner.reporting.report import Health
from daedalus.learner.reporting.run_reporter import RunReporter
from daedalus.learner.reporting.user_metrics import UserMetrics
from daedalus.learner.run.annealing import Annealing
from daedalus.learner.run.counters import RunCounters
from daedalus.learner.run.event_file import EventFile
from daedalus.learner.run.heartbeat import Heartbeat
from daedalus.learner.run.rollout_length import check_rollout_length
from daedalus.learner.run.run_directory import METRICS, SUMMARY, write_json
from daedalus.learner.serving.actor_server import ActorServer
from daedalus.learner.serving.evaluation_server import EvaluationServer
from daedalus.learner.serving.evaluations import Evaluations
from daedalus.learner.serving.orders import Orders
from daedalus.learner.target_confirmation import TargetConfirmation
from daedalus.learner.training.errors import CheckpointMismatchError
from daedalus.policy.saving.saved_policy import SavedPolicy
from daedalus.policy.user_modules import NO_MODULES, UserModules
from daedalus.protocol.spaces import Spaces
from daedalus.protocol.spec import RunSpec
from daedalus.protocol.status import RunStatus
from daedalus.protocol.uploads import Gradient, Rollout, Upload
from daedalus.transport.interface import Transport

if TYPE_CHECKING:
    from daedalus.learner.ranks.leader import Distribution
    from daedalus.learner.training.checkpoint import Checkpoint
    from daedalus.learner.training.checkpointer import Checkpointer
    from daedalus.learner.training.learner import Learner

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
        spaces: Spaces | None = None,
        modules: UserModules = NO_MODULES,
        certificate_days_left: Callable[[], float | None] = lambda: None,
        user_metrics: UserMetrics | None = None,
        open_ranks: OpenRanks = one_process,
        confirms: bool = False,
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
          spaces: spaces that all actors must have, if they are known; those of a checkpoint have precedence.
          modules: modules that may be imported for the policy.
          certificate_days_left: function that returns the days until the certificate of this process expires.
          user_metrics: metrics of the program that started the run.
          open_ranks: connects the other processes of the learner.
          confirms: whether a launcher plays new episodes to confirm that the target is reached.
        """
        self._spec, self._directory, self._stop, self._progress = spec, directory, stop, progress
        self._open_writers, self._modules = open_writers, modules
        self._open_ranks = open_ranks
        self._ranks: Distribution | None = None  # None: not connected yet
        self._restored, self._initial = restored, initial if restored is None else None
        self._counters = RunCounters(spec.training.target_episodes)
        self._annealing = Annealing(budget=spec.training.env_steps)
        if restored is not None:
            self._counters.restore(restored.counters)
            self._counters.forget_target(restored.policy.spec.training, spec.training)
            self._annealing = _resumed_annealing(restored, spec)
        self.learner_epoch = epoch = secrets.randbits(62)
        self._evaluations = Evaluations(epoch, self._counters)
        self._heartbeat = Heartbeat(directory)
        self._event_file = EventFile(directory)
        self._health = Health(
            started=started, updated=started, actor_seen=started, certificate_days_left=certificate_days_left
        )
        self._orders = Orders(stop)
        self._server = ActorServer(
            directory.name,
            spec,
            transport,
            self._counters,
            self._status,
            learner_epoch=epoch,
            start_version=restored.policy.policy_version if restored else 0,
            spaces=restored.policy.spaces if restored else spaces,
            orders=self._orders,
        )
        self._confirmation = None
        if confirms and spec.training.stop_when_solved:
            self._confirmation = TargetConfirmation(
                directory,
                spec.training,
                self._counters,
                self._server.events,
                stop,
                lock=self._server.lock,
                beat=self._beat_without_updates,
            )
        self._evaluation_server = EvaluationServer(self._server.evaluations, self._evaluations, self._server.publisher)
        self._reporter = RunReporter(
            directory.name,
            spec,
            epoch,
            counters=self._counters,
            annealing=self._annealing,
            fleet=self._server.fleet,
            lock=self._server.lock,
            evaluations=self._evaluations,
            health=self._health,
            started=started,
            user_metrics=user_metrics or UserMetrics(),
        )

    def run(self) -> Outcome:
        """Serve actors and train until the target is reached, the budget is used or the stop event is set.

        Once training has begun, the run always ends with a checkpoint and a summary. Raises TransportError if another
        learner serves the run, CheckpointMismatchError if a checkpoint does not fit the settings, NetworkError if
        the policy or the algorithm does not support the spaces, SettingsError if the device is not available or
        rollouts are too short for masked actions, RankLostError or RanksDisagreeError of the other processes of the
        learner.
        """
        try:
            self._server.open()
            self._load_history()
            from daedalus.learner.training.learner import Learner

            fleet = self._server.fleet
            self._ranks = ranks = self._open_ranks(self._spec, self._stop)
            if ranks is None or (fleet.spaces is None and not self._await_actor()):
                return self._stopped_without_actors()
            spaces = fleet.spaces
            assert spaces is not None
            check_rollout_length(self._spec, spaces)
            learner = Learner(self._spec.training, self._spec.policy, spaces, self._modules, ranks)
            if self._restored is not None:
                policy = self._restored.policy
                learner.restore(policy.policy_version, policy.weights, self._restored.state)
                if learner.learning_rate(self._annealing.at(self._counters.env_steps)) == 0.0:
                    _logger.warning(
                        "the learning rate has been annealed to 0: the policy changes no more; "
                        "start a new run from its weights, with --init-from"
                    )
            if self._initial is not None:
                _load(learner, self._initial)
            checkpointer = self._checkpointer(learner)
            if self._initial is not None:
                checkpointer.save()  # a learner that is killed before its first checkpoint continues from this one
            ranks.begin(spaces, learner.shared_state)
            if self._restored is None and not self._await_actor():
                return self._stopped_without_actors()
            return self._learn(learner, checkpointer)
        except RankLostError:
            if not self._stop.is_set():  # a signal may end all processes of the learner at once
                raise
            return self._stopped_without_actors()
        finally:
            self._server.close(_STOPPED)  # unless it is closed
            self._heartbeat.clear()
            if self._ranks is not None:
                self._ranks.close()

    def _await_actor(self) -> bool:
        """Wait until an actor has joined, and return whether one has; False if the run is stopped first."""
        return self._server.await_actor(self._stop, self._beat)

    def _beat(self) -> None:
        """Show the supervisor and the other ranks that this process works."""
        self._heartbeat.beat()
        if self._ranks is not None:
            self._ranks.wait()

    def _stopped_without_actors(self) -> Outcome:
        _logger.info("stopped before the first actor joined")
        ordered = self._orders.stopped
        return Outcome(solved=False, finished=False, saved=True, seconds_to_target=None, ordered=ordered)

    def _load_history(self) -> None:
        """Continue the metrics of the processes before, as far as the checkpoint."""
        if self._restored is None:
            return
        try:
            for row in read_rows(self._directory / METRICS):
                if row["env_steps"] <= self._counters.env_steps:
                    self._server.history.add(row)
        except (OSError, ValueError) as error:
            _logger.warning("the metrics before the checkpoint cannot be read: %s", error)

    def _checkpointer(self, learner: "Learner") -> "Checkpointer":
        """Publish the policy and return its checkpointer."""
        from daedalus.learner.training.checkpointer import Checkpointer

        program, spaces = learner.program(), self._server.fleet.spaces
        assert spaces is not None
        self._server.offer_policy(program, learner.state_size, learner.gradient_shapes)
        self._add_gradient_inputs(learner)
        self._server.publisher.publish(learner.policy_version, learner.weights())
        return Checkpointer(
            self._directory,
            self._spec,
            spaces,
            learner,
            program,
            counters=lambda: self._reporter.counters_state(time.monotonic()),
            evaluations=self._evaluations,
            health=self._health,
            events=self._server.events,
        )

    def _learn(self, learner: "Learner", checkpointer: "Checkpointer") -> Outcome:
        """Run the main loop, then write the last metrics row, checkpoint and summary, and let the actors leave."""
        recorder = Recorder(self._open_writers, self._progress)
        self._reporter.begin(time.monotonic())
        finished, saved, ended = False, None, None
        try:
            ended = self._loop(learner, checkpointer, recorder)
            finished = self._is_finished()
        except RankLostError:
            if not self._stop.is_set():  # a signal may end all processes of the learner at once
                raise
        finally:
            ended = ended or time.monotonic()
            try:
                self._server.close(_FINISHED if finished else _STOPPED, finished=finished)
                self._record(recorder, learner, ended, last=True)
                recorder.close()
            finally:
                saved = checkpointer.save(last=True)
        self._write_summary(finished, ended)
        env_steps = f"{self._counters.env_steps:,} env_steps"
        if finished:
            self._server.await_departures(self._stop)
        elif saved is not None:
            _logger.info("stopped; checkpoint saved at %s: %s", env_steps, saved)
        return Outcome(
            solved=self._counters.seconds_to_target is not None,
            finished=finished,
            saved=saved is not None,
            seconds_to_target=self._counters.seconds_to_target,
            ordered=self._orders.stopped,
        )

    def _is_finished(self) -> bool:
        """Return whether the run is over, rather than stopped."""
        training, solved = self._spec.training, self._counters.seconds_to_target is not None
        return self._counters.env_steps >= training.env_steps or (solved and training.stop_when_solved)

    def _loop(self, learner: "Learner", checkpointer: "Checkpointer", recorder: Recorder) -> float:
        """Train until the run ends. Return when training ended, on the monotonic clock: before the confirmation."""
        training, service, counters = self._spec.training, self._spec.service, self._counters
        now = time.monotonic()
        log_at, save_at = now + service.log_seconds, now + service.checkpoint_seconds
        while not self._stop.is_set() and counters.env_steps < training.env_steps:
            self._beat()
            self._update(learner)
            self._evaluation_server.serve(learner, checkpointer, counters.env_steps)
            now = time.monotonic()
            if self._reaches_target(learner, checkpointer):
                counters.seconds_to_target = self._reporter.wall_seconds(now)
                if training.stop_when_solved:
                    return now
            if now >= log_at:
                self._record(recorder, learner, now)
                log_at = now + service.log_seconds
                if hint := self._reporter.hint():
                    _logger.warning("%s", hint)
            if now >= save_at or self._orders.take_checkpoint():
                checkpointer.save()
                save_at = time.monotonic() + service.checkpoint_seconds
        return time.monotonic()

    def _reaches_target(self, learner: "Learner", checkpointer: "Checkpointer") -> bool:
        """Return whether the target is reached for the first time, and new episodes confirm it if they are played."""
        if self._counters.seconds_to_target is not None or not self._counters.is_solved(self._spec.training):
            return False
        return self._confirmation is None or self._confirmation.confirm(learner.policy_version, checkpointer)

    def _beat_without_updates(self) -> None:
        """Show that this process works, although it does not train."""
        self._beat()
        self._health.updated = time.monotonic()

    def _record(self, recorder: Recorder, learner: "Learner", now: float, *, last: bool = False) -> None:
        row = self._reporter.row(learner, now, last=last)
        self._server.history.add(row)
        recorder.record(row, self._reporter.details(learner))
        self._event_file.add(self._server.events.take_new())

    def _update(self, learner: "Learner") -> None:
        """Train on one batch and publish the result. Return without an update if no batch is complete soon."""
        env_steps = self._counters.env_steps
        progress = self._annealing.at(env_steps)
        rollouts = self._server.rollouts.take_batch(learner.policy_version)
        self._health.left_out = self._server.rollouts.left_out
        if not rollouts:
            return
        skipped = learner.updates_skipped
        left_out = self._learn_from(rollouts, learner, progress)
        learner.anneal_exploration(self._spec.training.exploration_annealing(progress, env_steps))
        self._add_gradient_inputs(learner)
        self._server.publisher.publish_if_due(learner.policy_version, learner.weights(), len(rollouts))
        self._server.rollouts.count_trained(rollouts, left_out)
        self._health.updated = self._health.actor_seen = time.monotonic()
        skipped = learner.updates_skipped - skipped
        if skipped and not self._health.gradient_fault:
            _logger.warning("update skipped: the gradient is not finite; the weights are unchanged")
        self._health.gradient_fault = skipped > 0
        self._counters.updates_skipped += skipped

    @staticmethod
    def _learn_from(uploads: Sequence[Upload], learner: "Learner", progress: float) -> list[Upload]:
        """Train on one batch. Return the rollouts that were left out; gradients were checked before."""
        gradients = [upload for upload in uploads if isinstance(upload, Gradient)]
        if gradients:
            learner.apply(gradients, progress)
            return []
        return [*learner.step([upload for upload in uploads if isinstance(upload, Rollout)], progress)]

    def _add_gradient_inputs(self, learner: "Learner") -> None:
        """Let the next snapshots carry what actors need to compute gradients, if they do."""
        if self._spec.uploads_gradients:
            progress = self._annealing.at(self._counters.env_steps)
            self._server.publisher.extras = learner.gradient_inputs(progress)

    def _status(self) -> RunStatus:
        return self._reporter.status(self._server.rollouts.queue_bytes, time.monotonic())

    def _write_summary(self, finished: bool, now: float) -> None:
        content = self._reporter.summary(finished=finished, now=now)
        if self._confirmation is not None and (result := self._confirmation.result) is not None:
            content["confirmation"] = result
            content["confirmation_return_mean"] = result["return_mean"]
        try:
            write_json(self._directory / SUMMARY, content)
        except OSError as error:
            _logger.warning("summary not written: %s", error.strerror)


def _resumed_annealing(restored: "Checkpoint", spec: RunSpec) -> Annealing:
    """Return the annealing of a run that continues from a checkpoint, perhaps with another budget."""
    saved = restored.counters.get("annealing", {"budget": restored.policy.spec.training.env_steps})
    return Annealing(**saved).resumed(restored.counters["env_steps"], spec.training.env_steps)


def _load(learner: "Learner", policy: SavedPolicy) -> None:
    """Begin with the weights of another run. Raises CheckpointMismatchError."""
    try:
        learner.load(policy.weights)
    except CheckpointMismatchError as error:
        raise CheckpointMismatchError(f"--init-from {policy.directory}: {error}") from None
    _logger.info("initial weights: policy version %d of %s", policy.policy_version, policy.directory)
