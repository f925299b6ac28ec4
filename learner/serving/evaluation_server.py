"""Answers to evaluators, made on the learner's thread between two updates. Not a thread of its own."""

import logging
import time
from collections.abc import Callable
from typing import TYPE_CHECKING

from daedalus.learner.run.evaluations import Evaluations
from daedalus.learner.serving.evaluation_queue import EvaluationQueue
from daedalus.learner.serving.snapshot_publisher import SnapshotPublisher
from daedalus.protocol.codec import encode
from daedalus.protocol.messages import Refusal

if TYPE_CHECKING:
    from daedalus.learner.training.checkpointer import Checkpointer
    from daedalus.learner.training.learner import Learner

# The policies of evaluators are saved first, on the thread that trains. Requests wait until a save is due again,
# however many there are, so that they take at most a twentieth of the training time. An evaluator hardly notices.
_MIN_SECONDS, _MAX_SECONDS = 0.5, 30.0  # between two saves; an evaluator waits 60 s for its answer
_PAUSE_PER_SAVE = 20.0  # shortest pause, in durations of the last save

_logger = logging.getLogger(__name__)


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
        self._due = clock()  # of the next save

    def serve(self, learner: "Learner", checkpointer: "Checkpointer", env_steps: int) -> None:
        """Answer all waiting reports, and the waiting requests if a save is due.

        Args:
          learner: has the newest policy.
          checkpointer: saves the policy before it is handed out, because it may turn out to be the best.
          env_steps: number of env_steps that the policy was trained on.
        """
        for request, report in self._queue.take_reports():
            answer, text = self._evaluations.report(report)
            request.reply(encode(answer))
            if text:
                _logger.info(text)
        if self._clock() >= self._due:
            self._hand_out(learner, checkpointer, env_steps)

    def _hand_out(self, learner: "Learner", checkpointer: "Checkpointer", env_steps: int) -> None:
        waiting = self._queue.take_requests()
        if not waiting:
            return
        began = self._clock()
        directory = checkpointer.ensure_saved()
        ended = self._clock()
        self._due = ended + min(max(_PAUSE_PER_SAVE * (ended - began), _MIN_SECONDS), _MAX_SECONDS)
        if directory is None:
            refusal = encode(Refusal(code="not_ready", reason="the checkpoint of the policy could not be saved"))
            for request, _ in waiting:
                request.reply(refusal)
            return
        version = learner.policy_version
        if version != self._publisher.version:
            self._publisher.publish(version, learner.weights())
        for request, message in waiting:
            self._evaluations.begin(message.evaluator, directory, version, env_steps)
            request.reply(self._publisher.newest())
