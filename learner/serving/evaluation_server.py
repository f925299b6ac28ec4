"""Answers to evaluators, made on the learner's thread between two updates. Not a thread of its own."""

import math
import time
from collections.abc import Callable
from typing import TYPE_CHECKING

from daedalus.learner.run.evaluations import Evaluations
from daedalus.learner.serving.evaluation_queue import EvaluationQueue
from daedalus.learner.serving.snapshot_publisher import SnapshotPublisher
from daedalus.protocol.codec import encode

if TYPE_CHECKING:
    from daedalus.learner.training.checkpointer import Checkpointer
    from daedalus.learner.training.learner import Learner

# The policies of evaluators are saved, beside training. Requests wait until a save is due again, however many there
# are, so that saving takes at most a twentieth of the time. An evaluator hardly notices.
_MIN_SECONDS, _MAX_SECONDS = 0.5, 30.0  # between two saves; an evaluator waits 60 s for its answer
_PAUSE_PER_SAVE = 20.0  # shortest pause, in durations of the last save


class EvaluationServer:
    """Answers the reports of evaluators, and hands out the newest policy to all evaluators that wait for one."""

    def __init__(
        self,
        queue: EvaluationQueue,
        evaluations: Evaluations,
        publisher: SnapshotPublisher,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        """`clock` returns the time on the monotonic clock, in seconds."""
        self._queue, self._evaluations, self._publisher, self._clock = queue, evaluations, publisher, clock
        self._saved_at, self._took = -math.inf, 0.0  # the last save, and how long it kept the learner from training

    def serve(self, learner: "Learner", checkpointer: "Checkpointer", env_steps: int) -> None:
        """Answer all waiting reports, and the waiting requests if a save is due.

        Args:
          learner: has the newest policy.
          checkpointer: saves each policy that is handed out, because it may turn out to be the best.
          env_steps: number of env_steps that the policy was trained on.
        """
        for request, report in self._queue.take_reports():
            self._evaluations.heard = self._clock()
            answer, evaluated = self._evaluations.report(report)
            request.reply(encode(answer))
            if evaluated is not None:
                checkpointer.keep(evaluated)
        pause = _PAUSE_PER_SAVE * max(self._took, checkpointer.seconds)
        due = self._saved_at + min(max(pause, _MIN_SECONDS), _MAX_SECONDS)
        if checkpointer.idle and self._clock() >= due:
            self._hand_out(learner, checkpointer, env_steps)

    def _hand_out(self, learner: "Learner", checkpointer: "Checkpointer", env_steps: int) -> None:
        waiting = self._queue.take_requests()
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
            request.reply(self._publisher.newest())
        self._saved_at = self._evaluations.heard = self._clock()
        self._took = self._saved_at - began
