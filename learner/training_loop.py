"""The main loop of a learner process: update after update, and between them all that the learner's thread does."""

import logging
import math
import time
from collections.abc import Callable, Sequence

from daedalus.learner.reporting.run_reporter import RunReporter
from daedalus.learner.serving.actor_server import ActorServer
from daedalus.learner.serving.run_context import RunContext
from daedalus.learner.serving.snapshot_publisher import SnapshotPublisher
from daedalus.learner.serving.waiting_requests import EvaluationQueue
from daedalus.learner.target_confirmation import TargetConfirmation
from daedalus.learner.training.checkpointer import Checkpointer
from daedalus.learner.training.learner import Learner
from daedalus.protocol.codec import encode
from daedalus.protocol.uploads import Gradient, Rollout, Upload

_logger = logging.getLogger(__name__)


# The policies of evaluators are saved, beside training. Requests wait until a save is due again, however many there
# are, so that saving takes at most a twentieth of the time. An evaluator hardly notices.
_MIN_SECONDS, _MAX_SECONDS = 0.5, 30.0  # between two saves; an evaluator waits 60 s for its answer
_PAUSE_PER_SAVE = 20.0  # shortest pause, in durations of the last save


class EvaluationServer:
    """Answers the reports of evaluators, and hands out the newest policy to all evaluators that wait for one."""

    def __init__(
        self,
        context: RunContext,
        queue: EvaluationQueue,
        publisher: SnapshotPublisher,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        """`clock` returns the time on the monotonic clock, in seconds."""
        self._context, self._queue, self._publisher, self._clock = context, queue, publisher, clock
        self._evaluations = context.evaluations
        self._saved_at, self._took = -math.inf, 0.0  # the last save, and how long it kept the learner from training

    def serve(self, learner: Learner, checkpointer: Checkpointer) -> None:
        """Answer all waiting reports, and the waiting requests if a save is due.

        Args:
          learner: has the newest policy.
          checkpointer: saves each policy that is handed out, because it may turn out to be the best.
        """
        for request, report in self._queue.take_reports():
            self._evaluations.heard = self._clock()
            answer, evaluated = self._evaluations.report(report, self._context.learner_epoch)
            request.reply(encode(answer))
            if evaluated is not None:
                checkpointer.keep(evaluated)
        pause = _PAUSE_PER_SAVE * max(self._took, checkpointer.seconds)
        due = self._saved_at + min(max(pause, _MIN_SECONDS), _MAX_SECONDS)
        if checkpointer.idle and self._clock() >= due:
            self._hand_out(learner, checkpointer)

    def _hand_out(self, learner: Learner, checkpointer: Checkpointer) -> None:
        waiting, env_steps = self._queue.take_requests(), self._context.counters.env_steps
        if not waiting:
            return
        began = self._clock()
        # Handed out before it is written: where the disk is slow or full, evaluations go on.
        saving = checkpointer.begin(again=False)
        version = learner.policy_version
        if version != self._publisher.version:
            self._publisher.publish(version, learner.weights())
        for request, message in waiting:
            self._evaluations.begin(message.evaluator, saving.directory, version, env_steps)
            request.reply(self._publisher.snapshot())
        self._saved_at = self._evaluations.heard = self._clock()
        self._took = self._saved_at - began


class TrainingLoop:
    """Loop of one run: updates; between them it serves evaluators, records metrics, saves checkpoints, obeys orders."""

    def __init__(
        self,
        context: RunContext,
        server: ActorServer,
        learner: Learner,
        checkpointer: Checkpointer,
        confirmation: TargetConfirmation | None,
        beat: Callable[[], None],
    ) -> None:
        """Construct the loop.

        Args:
          context: progress of the run.
          server: source of the rollouts and of the orders; publishes the policy.
          learner: makes the updates.
          checkpointer: saves them.
          confirmation: confirms that the target is reached; None: it needs no confirmation.
          beat: called before each update, and while there is no batch.
        """
        self._context, self._counters, self._health = context, context.counters, context.health
        self._server, self._learner, self._checkpointer = server, learner, checkpointer
        self._orders, self._confirmation, self._beat = server.orders, confirmation, beat
        self._skipped = learner.updates_skipped  # that are counted
        self._evaluators = EvaluationServer(context, server.evaluations, server.publisher)

    def publish(self, program: bytes) -> None:
        """Offer the policy to the actors, before the first update."""
        learner = self._learner
        self._server.rollouts.updates_of = learner.updates_of
        self._server.rollouts.start_from(learner.policy_version + learner.updates_due)
        self._server.offer_policy(program, learner.state_size, learner.gradient_shapes)
        if self._context.spec.uploads_gradients:
            self._server.publisher.extras = lambda: learner.gradient_inputs(self._context.progress)
        self._server.publisher.publish(learner.policy_version, learner.weights())

    def run(self, reporter: RunReporter) -> float:
        """Train until the target is reached, the budget is used or the stop event is set.

        Return when training ended, on the monotonic clock: before the target was confirmed.
        """
        training, service = self._context.spec.training, self._context.spec.service
        now = time.monotonic()
        log_at, save_at = now + service.log_seconds, now + service.checkpoint_seconds
        # A copy of the run directory must have a newer epoch than a learner that has resumed here: save its count soon.
        soon_after = self._learner.policy_version if self._context.starts > 1 else math.inf
        while not self._context.stop.is_set() and (
            self._counters.env_steps < training.env_steps or self._learner.updates_due
        ):
            self._beat()
            reporter.look(self._update())
            self._evaluators.serve(self._learner, self._checkpointer)
            now = time.monotonic()
            if self._reaches_target():
                self._counters.seconds_to_target = self._context.wall_seconds(now)
                if training.stop_when_solved:
                    self._settle()
                    return now
            if now >= log_at:
                self._settle()
                reporter.record(self._learner, now)
                log_at = now + service.log_seconds
            due = now >= save_at or self._orders.checkpoint_wanted or self._learner.policy_version > soon_after
            if due and self._checkpointer.idle:
                answer = self._orders.take_checkpoint()
                self._checkpointer.begin(on_end=lambda saving, answer=answer: answer(saving.is_saved, saving.result))
                soon_after = math.inf
                save_at = now + service.checkpoint_seconds
        self._settle()
        return time.monotonic()

    def keep_received(self) -> None:
        """Let a replay buffer have the rollouts that were accepted, but not yet taken, when the run was stopped."""
        rollouts = self._server.rollouts
        while self._context.spec.algorithm.replay and not self._context.is_finished:
            batch = rollouts.take_batch(self._learner.policy_version, complete=False)
            if not batch:
                return
            left_out = self._learn_from(batch, self._context.progress)
            rollouts.count_trained(batch, left_out, self._learner.far_outside)

    def _reaches_target(self) -> bool:
        """Return whether the target is reached for the first time, and new episodes confirm it if they are played."""
        if self._counters.seconds_to_target is not None:
            return False
        league = self._context.league
        if league is not None and league.reaches_target:
            self._context.events.add("target", f"target reached: {self._context.spec.target}")
            return True
        if not self._counters.is_solved(self._context.spec):
            return False
        return self._confirmation is None or self._confirmation.confirm(self._learner, self._checkpointer)

    def _update(self) -> Sequence[Upload]:
        """Train on one batch, publish the result and return the batch; empty without one.

        Return without an update if no batch is complete soon.
        """
        learner, rollouts = self._learner, self._server.rollouts
        env_steps, progress = self._counters.env_steps, self._context.progress
        version, goes_on = learner.policy_version, learner.updates_due > 0
        batch = [] if goes_on else rollouts.take_batch(version)
        if self._context.league is not None:  # before the update: the first version is the policy of the beginning
            self._context.league.advance(learner, env_steps, self._checkpointer.add)
        self._health.left_out = rollouts.left_out
        if not (batch or goes_on):
            self._settle()  # a GPU is done with the newest batch by now
            return batch
        began = time.monotonic()
        left_out = self._learn_from(batch, progress)
        learner.anneal_exploration(self._context.spec.training.exploration_annealing(progress, env_steps))
        if learner.policy_version > version:  # a replay buffer that fills makes no update
            self._server.publisher.publish_if_due(learner.policy_version, learner.begin_weights, max(len(batch), 1))
        rollouts.count_trained(batch, left_out, learner.far_outside)
        now = time.monotonic()
        if learner.far_outside:
            self._health.note_far_outside(
                {each.identity.actor: name for each, name in learner.far_outside.items()}, now
            )
        self._health.note_update(now)
        self._counters.learning_seconds += now - began
        self._health.gradient_fault = self._count_skipped()
        return batch

    def _settle(self) -> None:
        """Wait until a GPU has made the updates of the newest batch, and count what was left out of them."""
        self._server.rollouts.count_trained([], self._learner.finish())
        self._health.gradient_fault |= self._count_skipped()

    def _count_skipped(self) -> bool:
        """Count the updates that were skipped since the last call, and warn of them. Return whether there were any."""
        skipped = self._learner.updates_skipped - self._skipped
        self._skipped += skipped
        self._counters.updates_skipped += skipped
        if skipped and not self._health.gradient_fault:
            _logger.warning(
                "update skipped: the gradient is not finite; the weights are unchanged. Look for nan in the losses of "
                "an algorithm of your own, and for very large observations and rewards, or lower training.learning_rate"
            )
        return skipped > 0

    def _learn_from(self, uploads: Sequence[Upload], progress: float) -> list[Upload]:
        """Train on one batch. Return rollouts that were left out of it, or of the last one; gradients were checked."""
        gradients = [upload for upload in uploads if isinstance(upload, Gradient)]
        if gradients:
            self._learner.apply(gradients, progress)
            return []
        return [*self._learner.step([upload for upload in uploads if isinstance(upload, Rollout)], progress)]
