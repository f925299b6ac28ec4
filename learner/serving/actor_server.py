"""The learner's side of the wire: who is let in, what is taken, what is told. The network never waits for learning.

    transport's threads   answer queries at once; rollouts only go onto a bounded queue
    intake thread         decodes and judges rollouts, answers them, fills the buffer
    slow links' thread    makes small snapshots for those whose links need them
    watchdog thread       has the transport reopened where nobody is heard and nobody could reach us

The main thread takes batches out and publishes snapshots. One condition guards what they share: fleet, buffer,
counters, and the version that rollouts are held against.
"""

import contextlib
import logging
import threading
import time
from collections import deque
from collections.abc import Callable

import numpy as np

from daedalus.learner.run.counters import RunCounters
from daedalus.learner.serving.fleet import Fleet
from daedalus.learner.serving.intake import Intake, Rejected, acknowledgement
from daedalus.learner.serving.query_responses import QueryResponses
from daedalus.learner.serving.request_queue import RequestQueue
from daedalus.learner.serving.rollout_buffer import BarrierBuffer, RolloutBuffer, StreamBuffer, TakenRollouts
from daedalus.learner.serving.snapshot_publisher import Publisher
from daedalus.protocol import keys
from daedalus.protocol.codec import ProtocolError, decode, encode
from daedalus.protocol.limits import EVALUATION_LIMITS
from daedalus.protocol.messages import (
    Acknowledgement,
    EvaluationReport,
    EvaluationRequest,
    Refusal,
    Rollout,
    StatusReport,
)
from daedalus.protocol.spaces import Spaces
from daedalus.protocol.spec import RunSpec
from daedalus.protocol.status import RunStatus
from daedalus.transport.interface import Request, Transport, TransportError

_logger = logging.getLogger(__name__)

HEARTBEAT_SECONDS = 0.2  # how soon a wait notices that it should stop
_WAITING_EVALUATIONS = 64  # at once; evaluators beyond that ask again later
_SILENCE_SECONDS = 10.0  # without a word from anybody for so long, the session may be dead
_RIVAL_SECONDS = 2.0  # for another learner of this run to say that it is there
_HINT_SECONDS = 3.0  # without an actor for so long, say how to start one


class ActorServer:
    """Serves one run's actors from `open` to `close`."""

    def __init__(
        self,
        run: str,
        spec: RunSpec,
        transport: Transport,
        counters: RunCounters,
        status: Callable[[Fleet], RunStatus],
        *,
        learner_epoch: int,
        start_version: int,
        spaces: Spaces | None,
    ) -> None:
        """`start_version` and `spaces` are those of the checkpoint that a run continues from, else 0 and None."""
        self.lock = threading.Condition()
        self.fleet = Fleet(spec.training.seed, spaces)
        self._run, self._spec, self._transport = run, spec, transport
        self._counters, self._status, self._epoch = counters, status, learner_epoch
        self._version = start_version  # rollouts of it are on-policy
        self._over = False
        self._buffer = _buffer(spec)
        self._intake = Intake(spec, learner_epoch, self.fleet)
        self._responses = QueryResponses(run, spec, learner_epoch, start_version, self.fleet, self.lock)
        self._requests = _queue(spec)
        self._publisher = Publisher(
            run, spec, learner_epoch, start_version, transport, self._responses, self.fleet, self._on_small_answer
        )
        self._judging = threading.Thread(target=self._judge_requests, name="intake", daemon=True)
        self._ended = threading.Event()
        self._heard_at = time.monotonic()
        self._watching = threading.Thread(target=self._watch_silence, name="watchdog", daemon=True)
        self._evaluations: deque[tuple[Request, EvaluationRequest | EvaluationReport]] = deque()

    def open(self) -> None:
        """Lets actors in. Raises TransportError if another learner serves a run of this name."""
        transport, run, responses = self._transport, self._run, self._responses
        if transport.query(keys.status(run), timeout=_RIVAL_SECONDS):
            raise TransportError(
                f"another learner serves run {run!r} there already: stop it, "
                "or name this one otherwise (the last part of --run-dir)"
            )
        self._judging.start()
        self._publisher.open()
        transport.watch_presence(keys.presence(run, "*", "*"), self._on_presence)
        self._serve(keys.rollouts(run, "*"), self._on_rollout)
        self._serve(keys.snapshots(run), self._publisher.answer)
        self._serve(
            keys.program(run, "*"), lambda request: request.reply(responses.program(keys.last_chunk(request.key)))
        )
        self._serve(keys.status(run), self._on_status)
        self._serve(keys.evaluations(run, "*"), self._on_evaluation)
        transport.declare_presence(keys.learner(run))
        # Last: who is let in finds all else there.
        self._serve(keys.join(run), lambda request: request.reply(responses.join(request.payload, time.monotonic())))
        self._watching.start()

    def _serve(self, key: str, handler: Callable[[Request], None]) -> None:
        def heard(request: Request) -> None:
            self._heard_at = time.monotonic()
            handler(request)

        self._transport.serve(key, heard)

    def close(self, reason: str) -> None:
        """Tells the actors that the run is over, and takes nothing more. Idempotent."""
        with self.lock:
            if self._over:
                return
            self._over = True
            self.lock.notify_all()
        self._publisher.close(reason)
        self._requests.close()
        for request, _ in self.take_evaluations():
            request.reply(encode(Refusal(code="finished", reason=reason)))
        self._ended.set()
        if self._judging.is_alive():
            self._judging.join(timeout=4.0)

    # ------------------------------------------------------------------------------------ the main thread

    def await_spaces(self, stop: threading.Event) -> Spaces | None:
        """Waits for an actor that knows the environment's spaces; None if told to stop first."""
        hint_at: float | None = time.monotonic() + _HINT_SECONDS
        with self.lock:
            while self.fleet.spaces is None and not stop.is_set():
                self.lock.wait(HEARTBEAT_SECONDS)
                if hint_at is not None and time.monotonic() > hint_at:
                    _logger.info("waiting for the first actor: `daedalus actor --connect ADDRESS` starts one")
                    hint_at = None
            return self.fleet.spaces

    def take_batch(self, version: int) -> list[Rollout]:
        """The rollouts of the next update, counted; none if no batch is complete within a heartbeat.

        `version` is the newest; from here on, rollouts of the one that this batch makes are the on-policy ones.
        """
        with self.lock:
            taken = self._take(version)
            if not taken.rollouts and not taken.stale:
                self.lock.wait(HEARTBEAT_SECONDS)
                taken = self._take(version)
            actors = self.fleet.actors  # one that was away for long may be forgotten by now
            for rollout in taken.stale:
                self._counters.rollouts_rejected["stale"] += 1
                if rollout.identity.actor in actors:
                    actors[rollout.identity.actor].rejected["stale"] += 1
            if taken.rollouts:
                self._counters.trained(taken.rollouts, version, self._spec.training.updates_per_batch)
                for rollout in taken.rollouts:
                    if rollout.identity.actor in actors:
                        actors[rollout.identity.actor].env_steps += int(np.count_nonzero(rollout.valid))
                self._version = version + self._spec.training.updates_per_batch
            self.lock.notify_all()
        return taken.rollouts

    def _take(self, version: int) -> TakenRollouts:
        return self._buffer.take(self.fleet.live, version)

    def take_evaluations(self) -> list[tuple[Request, EvaluationRequest | EvaluationReport]]:
        """What evaluators asked and told since the last call; each is to be answered."""
        with self.lock:
            taken = list(self._evaluations)
            self._evaluations.clear()
        return taken

    @property
    def published_version(self) -> int:
        """The policy version that was published last."""
        return self._publisher.version

    @property
    def queue_bytes(self) -> int:
        """How much waits to be judged."""
        return self._requests.bytes

    def newest_snapshot(self) -> bytes:
        """The snapshot that was published last, encoded."""
        return self._responses.snapshot()

    def offer_program(self, model: bytes, state_size: int) -> None:
        """Has the policy program ready for those who ask; rollouts come with `state_size` numbers of memory."""
        self._intake.state_size = state_size
        self._publisher.offer_program(model)

    def publish_if_due(self, policy_version: int, weights: dict[str, np.ndarray], rollouts: int) -> None:
        """Publishes a version that was made of so many rollouts, unless hardly an actor would play it."""
        with self.lock:
            live = len(self.fleet.live)
        if self._publisher.is_due(policy_version, rollouts, live):
            self.publish(policy_version, weights)

    def publish(self, policy_version: int, weights: dict[str, np.ndarray]) -> None:
        """Publishes a snapshot."""
        self._publisher.publish(policy_version, weights)
        self._counters.snapshots_published += 1

    # ----------------------------------------------------------------------------- the transport's threads

    def _on_presence(self, key: str, present: bool) -> None:
        life = keys.parse_presence(key)
        if life is not None:
            with self.lock:
                self.fleet.set_present(*life, present)
                self.lock.notify_all()

    def _on_rollout(self, request: Request) -> None:
        if self._over:
            request.reply(encode(Acknowledgement(verdict="finished")))
        elif not self._requests.offer(request):
            request.reply(encode(Acknowledgement(verdict="busy", policy_version=self._publisher.version)))
            with self.lock:
                actor = self.fleet.actors.get(keys.last_chunk(request.key))
                if actor is not None:
                    actor.busy += 1

    def _on_evaluation(self, request: Request) -> None:
        sender = keys.last_chunk(request.key)
        try:
            message = decode(request.payload, EVALUATION_LIMITS)
        except ProtocolError as error:
            request.reply(encode(Refusal(code="malformed", reason=str(error))))
            return
        if not isinstance(message, EvaluationRequest | EvaluationReport) or message.evaluator != sender:
            request.reply(encode(Refusal(code="malformed", reason="evaluators ask and report under their own name")))
            return
        with self.lock:
            refused = self._over or not self._publisher.program_hash or len(self._evaluations) >= _WAITING_EVALUATIONS
            if not refused:
                self._evaluations.append((request, message))
        if refused:
            code = "finished" if self._over else "not_ready"
            request.reply(encode(Refusal(code=code, reason="the learner has nothing to evaluate now")))

    def _on_status(self, request: Request) -> None:
        with self.lock:
            status = self._status(self.fleet)
        request.reply(encode(StatusReport(status=status)))

    # -------------------------------------------------------------------------------- the slow links' thread

    def _on_small_answer(self, name: str, size: int) -> None:
        with self.lock:
            actor = self.fleet.actors.get(name)
            if actor is not None:
                actor.compact_snapshots, actor.answered_bytes = True, actor.answered_bytes + size

    # --------------------------------------------------------------------------------- the watchdog thread

    def _watch_silence(self) -> None:
        while not self._ended.wait(_SILENCE_SECONDS / 2):
            if time.monotonic() > self._heard_at + _SILENCE_SECONDS:
                with contextlib.suppress(TransportError):  # no router there now: the session that is goes on looking
                    self._transport.reopen(unless_served=keys.status(self._run))

    # ----------------------------------------------------------------------------------- the intake thread

    def _judge_requests(self) -> None:
        while (request := self._requests.take()) is not None:
            sender = keys.last_chunk(request.key)
            content = self._intake.read(sender, request.payload)
            with self.lock:
                if (
                    self._spec.algorithm.synchronous
                    and isinstance(content, Rollout)
                    and not self._buffer.has_room_for(content)
                ):
                    content = Rejected(
                        verdict="rejected", cause="surplus", reason="an update takes one rollout of an actor"
                    )
                verdict = self._intake.judge(sender, content, self._version, time.monotonic())
                self.fleet.received(sender, request.size)
                if isinstance(verdict, Rollout):
                    self._store(verdict, len(request.payload))
                else:
                    self._counters.rollouts_rejected[verdict.cause] += 1
                answer = acknowledgement(verdict, self._publisher.version)
            request.reply(encode(Acknowledgement(verdict="finished") if self._over else answer))

    def _store(self, rollout: Rollout, size: int) -> None:
        """Puts a rollout into the buffer, waiting for room: the late answer is what holds its sender back."""
        while not self._buffer.has_room_for(rollout) and not self._over:
            self.lock.wait(HEARTBEAT_SECONDS)
        self._buffer.add(rollout)
        self._counters.accepted(rollout, size)
        self.lock.notify_all()


def _queue(spec: RunSpec) -> RequestQueue:
    """As long as what waits at its end can still be learned from when its turn comes.

    What comes beyond is told to come again: waiting here, it would only grow too old, and its sender would give up
    waiting for the answer.
    """
    batches = spec.training.policy_lag_bound // spec.training.updates_per_batch + 1
    return RequestQueue(spec.service.queue_bytes, max(batches * spec.batch_rollouts, 2 * spec.collection.actors))


def _buffer(spec: RunSpec) -> RolloutBuffer:
    if spec.algorithm.synchronous:
        return BarrierBuffer(spec.collection.actors)
    return StreamBuffer(spec.batch_rollouts, spec.training.policy_lag_bound)
