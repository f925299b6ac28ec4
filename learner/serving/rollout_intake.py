"""Intake of rollouts, from the network to a batch: a bounded queue, a thread that judges rollouts, a buffer.

    transport's threads   `offer`: put the undecoded rollout on the queue, or answer busy
    intake thread         decodes, judges and answers rollouts, and fills the buffer
    learner's thread      `take_batch`: takes complete batches out of the buffer

While the learner computes a batch, answers to accepted rollouts wait until it asks for the next one. So an actor plays
its next rollout with the snapshot of that batch: without the wait, actors would play far ahead of a learner that is
slower than they are, and rollouts would have a larger policy lag.

The lock of the run guards the fleet, the buffer, the counters and the version that the policy lag of rollouts is
relative to.
"""

import logging
import queue
import threading
import time
from collections import deque
from collections.abc import Callable, Mapping, Sequence, Set
from dataclasses import replace
from types import MappingProxyType

from daedalus.learner.run.counters import updates_of
from daedalus.learner.serving.actor_state import NON_FINITE, Actor, Fault
from daedalus.learner.serving.rollout_buffer import BarrierBuffer, RolloutBuffer, StreamBuffer, TakenRollouts
from daedalus.learner.serving.rollout_judge import Rejected, RolloutJudge, acknowledgement
from daedalus.learner.serving.run_context import RunContext
from daedalus.learner.serving.upload_checks import Shapes
from daedalus.protocol import keys
from daedalus.protocol.codec import encode
from daedalus.protocol.limits import EVALUATION_LIMITS, Limits
from daedalus.protocol.messages import Acknowledgement
from daedalus.protocol.spec import RunSpec
from daedalus.protocol.uploads import Rollout, Upload
from daedalus.transport.interface import Request

# Senders take a request for lost that waits 30 s, and send it again.
_OLDEST_SECONDS = 10.0  # while a request has waited longer, others are refused
LATE_SECONDS = 15.0  # after which a request needs an answer; an accepted rollout may wait for its batch after that


class RequestQueue:
    """First-in, first-out queue of requests. `offer` does not block, `take` does."""

    def __init__(self, max_bytes: int, max_requests: int) -> None:
        self.max_requests = max_requests
        self._max_bytes = max_bytes
        self._bytes = 0
        self._requests: deque[tuple[float, Request]] = deque()  # with the time of arrival, on the monotonic clock
        self._is_closed = self._is_woken = False
        self._changed = threading.Condition()

    def offer(self, request: Request) -> bool:
        """Queue a request and return True, or return False if a bound would be exceeded, or the oldest waits too long.

        An empty queue accepts a request of any size.
        """
        now = time.monotonic()
        with self._changed:
            full = len(self._requests) >= self.max_requests or self._bytes + request.size > self._max_bytes
            if self._requests and (full or now - self._requests[0][0] > _OLDEST_SECONDS):
                return False
            self._bytes += request.size
            self._requests.append((now, request))
            self._changed.notify()
        return True

    def take(self, timeout: float | None = None) -> tuple[float, Request] | None:
        """Wait for the oldest request; return when it arrived, and it, or None if the queue is closed and empty.

        Raises queue.Empty if no request comes within `timeout` seconds, or after `wake`.
        """
        with self._changed:
            self._changed.wait_for(lambda: self._requests or self._is_closed or self._is_woken, timeout)
            if self._is_woken or not (self._requests or self._is_closed):
                self._is_woken = False
                raise queue.Empty
            if not self._requests:
                return None
            arrived, request = self._requests.popleft()
            self._bytes -= request.size
            return arrived, request

    def take_late(self) -> list[Request]:
        """Take the requests that have waited so long that they need an answer now."""
        late, now = [], time.monotonic()
        with self._changed:
            while self._requests and now - self._requests[0][0] > LATE_SECONDS:
                _, request = self._requests.popleft()
                self._bytes -= request.size
                late.append(request)
        return late

    def wake(self) -> None:
        """Let `take` raise queue.Empty once."""
        with self._changed:
            self._is_woken = True
            self._changed.notify()

    @property
    def bytes(self) -> int:
        """Total size of the waiting requests, in bytes."""
        return self._bytes

    def close(self) -> None:
        """Close the queue: `take` returns the waiting requests, then None."""
        with self._changed:
            self._is_closed = True
            self._changed.notify()


_MOST_SECONDS = 10.0  # an answer waits no longer: its sender would take the rollout for lost


class HeldAnswers:
    """The requests whose answers wait. The caller guards it with a lock, and answers without the lock."""

    def __init__(self) -> None:
        self._since: float | None = None  # when the learner began to compute; None: it does not
        self._waiting: list[Request] = []
        self._released: list[Request] = []

    @property
    def holds(self) -> bool:
        """Whether answers wait now."""
        return self._since is not None

    def begin(self, now: float) -> None:
        """Hold answers from now on: the learner computes. `now` is on the monotonic clock, in seconds."""
        self._since = now

    def release(self) -> None:
        """Hold answers no more. Those that wait may be taken, also if the next batch begins before they are."""
        self._since = None
        self._released += self._waiting
        self._waiting = []

    def add(self, request: Request) -> None:
        """Add a request. The caller has checked `holds`."""
        self._waiting.append(request)

    def take(self, now: float) -> list[Request]:
        """Return the requests to answer now: those that were released, and all if they have waited too long."""
        if self._since is not None and now > self._since + _MOST_SECONDS:
            self.release()
        released, self._released = self._released, []
        return released


POLL_SECONDS = 0.2  # longest time until a waiting thread notices the end of the run
# Largest batch of a synchronous run in memory, whichever is larger: bytes, or the rollouts of so many fleets as large
# as the run expects.
_MOST_BATCH_BYTES, _MOST_FLEETS = 1 << 30, 8
_CLOSE_SECONDS = 4.0  # for the intake thread to answer the queued rollouts

_ACCEPTED = Acknowledgement(verdict="accepted")

_logger = logging.getLogger(__name__)


class RolloutIntake:
    """Server of the `rollouts` keys, from `open` to `close`."""

    def __init__(self, context: RunContext, published_version: Callable[[], int]) -> None:
        """Construct the intake. `published_version` returns the newest published policy version."""
        self._published_version = published_version
        self._spec, self._lock = context.spec, context.lock
        self._fleet, self._counters, self._events = context.fleet, context.counters, context.events
        self._version = context.start_version  # rollouts of this version have a policy lag of 0
        self._league, self._lessons = context.league, context.lessons
        # Number of updates of a batch. A learner with a replay buffer sets its own.
        self.updates_of: Callable[[Sequence[Upload]], int] = self._updates_of
        self._judge = RolloutJudge(context.spec, context.learner_epoch, context.fleet, context.league)
        self._buffer = _buffer(context.spec, self._judge)
        self._requests = RequestQueue(context.spec.service.queue_bytes, _most_requests(context.spec, live=0))
        self._named: set[str] = set()  # actors that were logged as left out
        self._ending: Acknowledgement | None = None  # of all rollouts after the end
        self._held = HeldAnswers()  # of accepted rollouts, until the next batch is taken
        self._thread = threading.Thread(target=self._judge_requests, name="intake", daemon=True)

    def open(self) -> None:
        """Start the intake thread."""
        self._thread.start()

    def end(self, *, finished: bool) -> None:
        """Answer every rollout `finished` from now on, `fenced` if the run is not over. The caller holds the lock."""
        if finished:
            self._ending = Acknowledgement(verdict="finished")
        else:
            self._ending = Acknowledgement(verdict="fenced", reason="the learner is stopping")
        self._held.release()
        self._requests.wake()

    def close(self) -> None:
        """Answer the queued rollouts, and stop the thread. Call after `end`, without the lock."""
        self._requests.close()
        if self._thread.is_alive():
            self._thread.join(timeout=_CLOSE_SECONDS)

    @property
    def queue_bytes(self) -> int:
        """Total size of the queued rollouts, in bytes."""
        return self._requests.bytes

    @property
    def left_out(self) -> Set[str]:
        """Names of the live actors that no batch waits for, because they deliver nothing."""
        with self._lock:
            return self._buffer.left_out

    def expect(self, state_size: int, gradient_shapes: Shapes) -> None:
        """Set the sizes that uploads have. Call before any actor has the program.

        Args:
          state_size: of the recurrent state in a rollout.
          gradient_shapes: shapes of the parameters that have gradients, by name.
        """
        self._judge.state_size, self._judge.gradient_shapes = state_size, gradient_shapes

    def offer(self, request: Request) -> None:
        """Queue a rollout, or answer busy. Does not block."""
        if self._ending is not None:
            request.reply(encode(self._ending))
        elif not self._refuses_size(request) and not self._requests.offer(request):
            self._answer_busy(request)

    def _answer_busy(self, request: Request) -> None:
        request.reply(encode(Acknowledgement(verdict="busy", policy_version=self._published_version())))
        with self._lock:
            actor = self._fleet.actors.get(keys.last_chunk(request.key))
            if actor is not None:
                actor.busy += 1

    def _refuses_size(self, request: Request) -> bool:
        """Refuse a request that cannot be a rollout of its sender, without a copy of its payload."""
        sender = keys.last_chunk(request.key)
        refused = self._judge.refuse_size(sender, request.size)
        if refused is None:
            return False
        with self._lock:
            refused = self._judge.decide(sender, refused, self._version, time.monotonic())
            assert isinstance(refused, Rejected)
            self._count_rejection(sender, refused)
        request.reply(encode(acknowledgement(refused, self._published_version())))
        return True

    # ------------------------------------------------------------------------------------ the learner's thread

    def take_batch(self, version: int, *, complete: bool = True) -> list[Upload]:
        """Return the rollouts of the next batch, or an empty list if no batch is complete within POLL_SECONDS.

        The rollouts are counted as trained. From now on the policy lag is relative to the version after this batch,
        because actors may have its snapshot before the next batch is complete.

        Args:
          version: newest policy version, before this batch.
          complete: False: at the end of a run, what is there is a batch.
        """
        with self._lock:
            self._held.release()
            self._requests.wake()  # the intake thread answers: a congested link must not stop the learner
            taken = self._take(version, complete)
            if not taken.rollouts and not taken.stale and complete:
                self._lock.wait(POLL_SECONDS)
                taken = self._take(version, complete)
            self._count(taken, version)
            if taken.rollouts:
                self._held.begin(time.monotonic())
            self._lock.notify_all()
        return taken.rollouts

    def start_from(self, version: int) -> None:
        """Accept rollouts of this policy version, which updates that are due will make without a further batch."""
        with self._lock:
            self._version = max(self._version, version)

    def count_trained(
        self,
        rollouts: Sequence[Upload],
        left_out: Sequence[Upload],
        far_outside: Mapping[Upload, str] = MappingProxyType({}),
    ) -> None:
        """Count the rollouts of a batch for their senders, after its updates.

        Args:
          rollouts: the rollouts of the batch.
          left_out: those that were left out of updates, because they have no finite gradient; also those of earlier
            batches, of which it is known only now.
          far_outside: those of the batch that were left out because they are far outside what others send; and their
            components.
        """
        with self._lock:
            earlier = [each for each in left_out if not any(each is rollout for rollout in rollouts)]
            for rollout in [*rollouts, *earlier]:
                fault = None
                if any(rollout is each for each in left_out):
                    fault = NON_FINITE
                elif rollout in far_outside:
                    fault = Fault("outside", f"numbers far outside those of the other actors ({far_outside[rollout]})")
                actor = self._fleet.find(rollout.identity)
                if actor is not None:
                    actor.count_trained(fault)
                if fault is not None:
                    self._count_fault(fault, rollout.identity.actor, actor)

    def _count_fault(self, fault: Fault, name: str, actor: Actor | None) -> None:
        self._fleet.changed()
        self._counters.rollouts_rejected[fault.cause] += 1
        text = f"a rollout of actor {name!r} has {fault.what}, and was left out"
        self._events.add("rejected", text, actor=name, cause=fault.cause, level=logging.WARNING)
        if actor is not None and actor.quarantined:
            text = f"quarantined: {actor.quarantined}"
            self._events.add("quarantined", text, actor=name, level=logging.WARNING)

    def _take(self, version: int, complete: bool) -> TakenRollouts:
        live = self._fleet.live
        self._requests.max_requests = _most_requests(self._spec, len(live))
        taken = self._buffer.take(live, version, time.monotonic(), complete=complete)
        self._named &= self._fleet.actors.keys()
        for name in sorted(self._buffer.left_out - self._named):
            self._named.add(name)
            _logger.warning(
                "batches no longer wait for actor %r, which is connected but far slower than the others, or hung: "
                "examine its environment",
                name,
            )
        return taken

    def _count(self, taken: TakenRollouts, version: int) -> None:
        actors = self._fleet.actors  # an actor that was absent for long may have been evicted
        for rollout in taken.stale:
            self._counters.rollouts_rejected["stale"] += 1
            if rollout.identity.actor in actors:
                actors[rollout.identity.actor].rejected["stale"] += 1
        if not taken.rollouts:
            return
        updates = self.updates_of(taken.rollouts)
        self._counters.trained(taken.rollouts, version, updates)
        self._lessons.add(taken.rollouts, self._counters.env_steps)
        for rollout in taken.rollouts:
            if rollout.identity.actor in actors:
                actors[rollout.identity.actor].env_steps += rollout.env_steps
        self._version = max(self._version, version + updates)

    def _updates_of(self, uploads: Sequence[Upload]) -> int:
        return updates_of(self._spec.training, uploads, memory=self._judge.state_size > 0)

    # --------------------------------------------------------------------------------------- the intake thread

    def _judge_requests(self) -> None:
        while True:
            self._answer_held()
            try:
                taken = self._requests.take(POLL_SECONDS)
            except queue.Empty:
                continue
            if taken is None:
                break
            arrived, request = taken
            sender, payload = keys.last_chunk(request.key), request.payload
            began = time.monotonic()
            content = self._judge.read(sender, payload)
            self._counters.decoding_seconds += time.monotonic() - began
            with self._lock:
                too_fast = self._judge.is_too_fast(content, time.monotonic())
            if too_fast or not self._wait_for_room(content, arrived + LATE_SECONDS):
                self._answer_busy(request)
                continue
            with self._lock:
                answer = self._decide(sender, content, len(payload))
                is_held = answer.verdict == "accepted" and self._held.holds and self._ending is None
                if is_held:
                    self._held.add(request)
            if not is_held:
                request.reply(encode(self._ending or answer))
        with self._lock:
            self._held.release()
        self._answer_held()

    def _wait_for_room(self, content: Upload | Rejected, answer_by: float) -> bool:
        """Wait until the buffer has room; return False if there is none by `answer_by`, on the monotonic clock.

        No other rollouts are judged meanwhile, which slows their senders down. But no answer is late: its sender would
        take the rollout for lost, and send it again.
        """
        while True:
            with self._lock:
                if self._has_room_for(content):
                    return True
                self._lock.wait(POLL_SECONDS)
            self._answer_held()
            for late in self._requests.take_late():
                self._answer_busy(late)
            if time.monotonic() > answer_by:
                return False

    def _has_room_for(self, content: Upload | Rejected) -> bool:
        """Return whether content can be judged now. The barrier rejects a rollout that it has no room for."""
        if isinstance(content, Rejected) or self._ending is not None or self._spec.algorithm.synchronous:
            return True
        return self._buffer.has_room_for(content)

    def _answer_held(self) -> None:
        """Answer the accepted rollouts whose answers need not wait any more."""
        with self._lock:
            answers = [
                (request, self._ending or self._final_answer(keys.last_chunk(request.key), _ACCEPTED))
                for request in self._held.take(time.monotonic())
            ]
        for request, answer in answers:
            request.reply(encode(replace(answer, policy_version=self._published_version())))

    def _decide(self, sender: str, content: Upload | Rejected, size: int) -> Acknowledgement:
        surplus = self._is_surplus(content)
        if not isinstance(content, Rejected) and not surplus:
            self._buffer.heard(sender)
        verdict = self._judge.decide(sender, content, self._version, time.monotonic(), surplus=surplus)
        self._fleet.received(sender, size)
        if not isinstance(verdict, Rejected) or verdict.cause in ("stale", "surplus"):
            self._count_matches(content)
        if isinstance(verdict, Rejected):
            self._count_rejection(sender, verdict)
        else:
            self._buffer.add(verdict)
            self._counters.accepted(verdict, size)
            self._lock.notify_all()
        return self._final_answer(sender, acknowledgement(verdict, self._published_version()))

    def _count_matches(self, content: Upload | Rejected) -> None:
        """Count the results of matches in a rollout that was received for the first time, even if not learned from."""
        if self._league is not None and isinstance(content, Rollout) and content.matches is not None:
            self._league.add(content.matches)

    def _final_answer(self, sender: str, answer: Acknowledgement) -> Acknowledgement:
        """Return the answer to a rollout, `drained` and by whom if its actor is asked to leave."""
        actor = self._fleet.actors.get(sender)
        if actor is None or not actor.drained_by or answer.verdict not in ("accepted", "rejected"):
            return answer
        return replace(answer, verdict="drained", reason=f"drained by {actor.drained_by}")

    def _count_rejection(self, sender: str, rejected: Rejected) -> None:
        self._counters.rollouts_rejected[rejected.cause] += 1
        if rejected.verdict == "quarantined" and rejected.cause == "unfit":
            self._events.add("quarantined", f"quarantined: {rejected.reason}", actor=sender, level=logging.WARNING)
        else:
            text = f"rollout rejected as {rejected.cause}: {rejected.reason}"
            self._events.add("rejected", text, actor=sender, cause=rejected.cause)

    def _is_surplus(self, content: Upload | Rejected) -> bool:
        """Return whether the barrier already holds a rollout of the actor.

        Such a rollout is rejected: waiting for room would block the intake thread, and with it all other actors.
        """
        synchronous = self._spec.algorithm.synchronous
        return synchronous and not isinstance(content, Rejected) and not self._buffer.has_room_for(content)


def largest_request(spec: RunSpec) -> int:
    """Return the size of the largest query that a learner answers, in bytes: the learner receives none above it."""
    return max(Limits(max_bytes=spec.service.queue_bytes).message_bytes, EVALUATION_LIMITS.message_bytes)


def _most_requests(spec: RunSpec, live: int) -> int:
    """Return the number of rollouts that can be trained on before they are stale, with so many live actors.

    Further rollouts are answered busy: in the queue they would become stale.
    """
    batches = spec.policy_lag_bound_with(live) // spec.training.updates_per_batch + 1
    if spec.algorithm.replay:  # in which no rollout becomes stale
        batches = spec.algorithm.max_lag_batches
    return max(batches * spec.batch_rollouts, 2 * max(spec.collection.actors, live))


def _buffer(spec: RunSpec, judge: RolloutJudge) -> RolloutBuffer:
    if spec.algorithm.synchronous:
        actors = spec.collection.actors
        return BarrierBuffer(actors, lambda: max(_MOST_BATCH_BYTES, _MOST_FLEETS * actors * judge.expected_bytes))
    return StreamBuffer(spec.batch_rollouts, spec.policy_lag_bound_with)
