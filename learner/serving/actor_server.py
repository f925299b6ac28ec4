"""The learner's side of the protocol: joins, presence, status, intake of rollouts, publication of snapshots.

    transport's threads         answer queries immediately, and queue rollouts
    intake thread               rollout_intake.py
    compact snapshot thread     snapshot_publisher.py
    watchdog thread             SessionWatchdog

The learner's thread takes batches and publishes snapshots. Network threads never wait for an update.
"""

import contextlib
import logging
import threading
import time
from collections.abc import Callable
from functools import partial
from types import MappingProxyType

from daedalus.learner.serving.query_responses import JoinResponses, StatusResponses
from daedalus.learner.serving.received_orders import Orders
from daedalus.learner.serving.rollout_intake import POLL_SECONDS, RolloutIntake
from daedalus.learner.serving.run_context import RunContext
from daedalus.learner.serving.snapshot_publisher import SnapshotPublisher
from daedalus.learner.serving.upload_checks import Shapes
from daedalus.learner.serving.waiting_requests import EvaluationQueue
from daedalus.protocol import keys
from daedalus.protocol.codec import ProtocolError, decode, encode
from daedalus.protocol.limits import (
    CLIENT_REPORT_LIMITS,
    EVALUATION_LIMITS,
    JOIN_LIMITS,
    SNAPSHOT_REQUEST_LIMITS,
    STATUS_LIMITS,
    STATUS_REQUEST_LIMITS,
    Limits,
)
from daedalus.protocol.messages import (
    ActorsReport,
    ActorsRequest,
    Refusal,
    RunEnded,
    RunStatus,
)
from daedalus.transport.interface import RefusedError, Request, Transport, TransportError
from daedalus.transport.slow_calls import SlowCall

_logger = logging.getLogger(__name__)

_SILENCE_SECONDS = 10.0  # without any request for so long, the session may be dead
_LOOK_SECONDS = 2.0  # between looks for another learner of the run, and for its answer

# Asks each learner of the run for its epoch: no actor has a name after this one, so the answer is short. Only a learner
# can answer: access control lets actors and operators serve no key.
LOOK = encode(ActorsRequest(after="~"))


class SessionWatchdog:
    """Watchdog of one transport, from `open` to `close`."""

    def __init__(self, context: RunContext, transport: Transport, on_newer: Callable[[int], None]) -> None:
        """`on_newer` is called once, on the watchdog's thread, with the epoch of a newer learner of the run."""
        self._transport, self._on_newer, self._epoch = transport, on_newer, context.learner_epoch
        # This learner serves the key. The session is dead if a query on it over another session has no answer.
        self._status_key = keys.status(context.name)
        self._older: set[int] = set()  # epochs of older learners that were logged
        self._heard_at = self._tried_at = time.monotonic()
        self._closed = threading.Event()
        self._warned = False  # that the certificate is refused
        self._thread = threading.Thread(target=self._watch, name="session watchdog", daemon=True)

    def open(self) -> None:
        """Start the watchdog thread."""
        self._thread.start()

    def close(self) -> None:
        """Stop the watchdog. Does not wait for a session that is being opened."""
        self._closed.set()

    def heard(self) -> None:
        """Record that a request was received, which was not LOOK. Any thread may call this method."""
        self._heard_at = time.monotonic()

    def _watch(self) -> None:
        while not self._closed.wait(_LOOK_SECONDS):
            self._look()
            now = time.monotonic()
            if now > self._heard_at + _SILENCE_SECONDS and now > self._tried_at + _SILENCE_SECONDS / 2:
                self._tried_at = now
                self._reopen()

    def _look(self) -> None:
        """Look for other learners of the run. Calls `on_newer`, and closes the watchdog, if there is a newer one."""
        epochs = self._answering() - {self._epoch}
        if epochs and max(epochs) > self._epoch and not self._closed.is_set():
            self._closed.set()
            self._on_newer(max(epochs))
            return
        for epoch in sorted(epochs - self._older):
            self._older.add(epoch)
            _logger.warning(
                "another learner of this run answers (epoch %x): it is older than this one and steps down", epoch
            )

    def _answering(self) -> set[int]:
        """Return the epochs of the learners that answer."""
        epochs = set[int]()
        with contextlib.suppress(TransportError):  # the session is being replaced
            for answer in self._transport.query(self._status_key, LOOK, timeout=_LOOK_SECONDS):
                with contextlib.suppress(ProtocolError):  # of another release, which cannot be compared
                    report = decode(answer, STATUS_LIMITS)
                    epochs |= {report.page.learner_epoch} if isinstance(report, ActorsReport) else set()
        return epochs

    def _reopen(self) -> None:
        try:
            SlowCall(partial(self._transport.reopen, unless_served=self._status_key)).result.result()
        except RefusedError as error:  # it was revoked or has expired since the start
            if not self._warned:
                _logger.error("the learner cannot connect to its router: %s", error)
            self._warned = True
        except TransportError:
            pass  # no router is reachable: the present session keeps trying to connect
        else:
            self._warned = False


_OTHER_LEARNER_SECONDS = 2.0  # to wait for the answer of another learner of this run
_LEAVE_SECONDS = 5.0  # after the end of the run, for the actors to leave
_ASK_SECONDS = 2.0  # in which an actor asks again that was refused because its name is in use
_REPEAT_SECONDS = 0.5  # between repetitions of the message that the run is over
_START = "`daedalus actor --connect ADDRESS`"
_HINT_SECONDS = 3.0  # without an actor for so long, log how to start one


class ActorServer:
    """Server of the actors of one run, from `open` to `close`."""

    def __init__(self, context: RunContext, transport: Transport, status: Callable[[], RunStatus]) -> None:
        """Construct the server.

        Args:
          context: the run, its fleet and its counters, which the server updates.
          transport: the network.
          status: function that returns the status with the first page of actors; called with the lock held.
        """
        self.context, self._transport = context, transport
        self._run, self._lock, self._fleet, self._events = context.name, context.lock, context.fleet, context.events
        self._ended, self._ended_at = b"", 0.0  # the encoded RunEnded, after the end
        self._were_cut_off = False  # whether actors were absent at the end that were seen shortly before
        self._status, self._joins = StatusResponses(context, status), JoinResponses(context)
        self.orders, self.evaluations = Orders(context), EvaluationQueue()
        self.publisher = SnapshotPublisher(context, transport)
        self.rollouts = RolloutIntake(context, lambda: self.publisher.version)
        self._watchdog = SessionWatchdog(context, transport, self._step_down)

    def open(self) -> None:
        """Start to serve actors. Raises TransportError if another learner serves a run of this name."""
        transport, run = self._transport, self._run
        if transport.query(keys.status(run), timeout=_OTHER_LEARNER_SECONDS):
            raise TransportError(
                f"another learner already serves run {run!r}: stop that learner, "
                "or rename this run (the last part of --run-dir)"
            )
        self.rollouts.open()
        self.publisher.open()
        transport.watch_presence(keys.presence(run, "*", "*"), self._on_presence)
        self._serve(keys.rollouts(run, "*"), self.rollouts.offer)
        self._serve(keys.snapshots(run), self.publisher.answer, SNAPSHOT_REQUEST_LIMITS)
        self._serve(keys.program(run, "*"), self._on_program)
        self._serve(keys.status(run), self._on_status, STATUS_REQUEST_LIMITS)
        self._serve(keys.reports(run, "*"), self._on_report, CLIENT_REPORT_LIMITS)
        self._serve(keys.orders(run, "*"), self.orders.receive, STATUS_REQUEST_LIMITS)
        self._serve(keys.evaluations(run, "*"), self.evaluations.offer, EVALUATION_LIMITS)
        transport.declare_presence(keys.learner(run))
        # Last, because an actor that has joined uses all other keys.
        self._serve(keys.join(run, "*"), self._on_join, JOIN_LIMITS)
        self._watchdog.open()
        self._events.add("started", f"serving run {run!r}")

    def _serve(self, key: str, handler: Callable[[Request], None], limits: Limits | None = None) -> None:
        """Serve a key; refuse queries above `limits` without a copy of their payload."""

        def handle(request: Request) -> None:
            if key != keys.status(self._run):  # `_on_status` tells a request from the watchdog's own
                self._watchdog.heard()
            if limits is not None and request.size > limits.message_bytes:
                reason = f"the message has {request.size:,} bytes, more than {limits.message_bytes:,}"
                request.reply(encode(Refusal(code="malformed", reason=reason)))
            else:
                handler(request)

        self._transport.serve(key, handle)

    def close(self, reason: str, *, finished: bool = False) -> None:
        """Publish that the learner ends, and stop the threads. The first call decides.

        Until the transport is closed, every query is still answered: that the run is over, or that the learner stops.
        """
        with self._lock:
            if self._ended:
                return
            outcome = "finished" if finished else "stopped"
            self._ended = encode(RunEnded(learner_epoch=self.context.learner_epoch, outcome=outcome, reason=reason))
            self._ended_at = time.monotonic()
            self._were_cut_off = any(
                self._ended_at < actor.last_seen + _LEAVE_SECONDS and not self._fleet.is_present(actor)
                for actor in self._fleet.actors.values()
            )
        self._events.add("ended", reason)
        self._joins.end(finished=finished)
        self.publisher.end(self._ended)
        self._publish_end()
        with self._lock:
            self.rollouts.end(finished=finished)
            self._lock.notify_all()
        self.publisher.close()
        self.evaluations.end(reason, finished=finished)
        self._watchdog.close()
        self.rollouts.close()

    def _step_down(self, newer: int) -> None:
        """End this learner, because a newer one of the run answers. Called on the watchdog's thread.

        The server is closed at once: an update may take long, and until then actors would stay here.
        """
        with self._lock:
            if self._ended:
                return
        self.orders.step_down(newer)
        self.close("a newer learner of this run has taken over")
        _logger.warning(
            "a newer learner of run %r answers (epoch %x; this one is %x): this learner steps down, and the run goes "
            "on there. If that is another run, rename one of the two (the last part of --run-dir)",
            self._run,
            newer,
            self.context.learner_epoch,
        )

    def _publish_end(self) -> None:
        with contextlib.suppress(TransportError):  # the session is being replaced; actors receive a repetition
            self._transport.publish(keys.run_end(self._run), self._ended)

    def await_departures(self) -> None:
        """Wait until all actors have left, at most 5 s, and repeat that the run is over. Call after `close`."""
        repeat_at = self._ended_at + _REPEAT_SECONDS
        while self._expects_actors(time.monotonic()) and not self.context.stop.is_set():
            with self._lock:
                self._lock.wait(POLL_SECONDS)
            if time.monotonic() >= repeat_at:
                self._publish_end()
                repeat_at += _REPEAT_SECONDS
        self._publish_end()  # to whoever has just begun to join

    def _expects_actors(self, now: float) -> bool:
        """Return whether an actor may not know of the end yet: it is present, was cut off, or is about to ask again."""
        if now > self._ended_at + _LEAVE_SECONDS:
            return False
        with self._lock:
            return bool(self._fleet.live) or self._were_cut_off or now < self._joins.postponed_at + _ASK_SECONDS

    def await_actor(self, on_wait: Callable[[], None] = lambda: None) -> bool:
        """Wait until an actor has joined, and return whether one has; False if the run is stopped first.

        `on_wait` is called again and again meanwhile.
        """
        hint_at, hinted = time.monotonic() + _HINT_SECONDS, None
        with self._lock:
            while not self._fleet.has_had_actors and not self.context.stop.is_set():
                on_wait()
                self._lock.wait(POLL_SECONDS)
                if time.monotonic() > hint_at and hinted != self._joins.preparing:
                    hinted = self._joins.preparing
                    doing = f"{hinted} makes its environments" if hinted else f"start one with {_START}"
                    _logger.info("waiting for the first actor: %s", doing)
            return self._fleet.has_had_actors

    def offer_policy(self, program: bytes, state_size: int, gradient_shapes: Shapes = MappingProxyType({})) -> None:
        """Make the policy program available to actors. See RolloutIntake.expect for the sizes."""
        self.rollouts.expect(state_size, gradient_shapes)
        self.publisher.offer_program(program)
        self.evaluations.open()

    # ----------------------------------------------------------------------------- the transport's threads

    def _on_presence(self, key: str, present: bool) -> None:
        actor = keys.parse_presence(key)
        if actor is not None:
            with self._lock:
                changed = self._fleet.set_present(*actor, present, time.monotonic())
                self._lock.notify_all()
            if changed:
                kind, text = ("joined", "connected again") if present else ("left", "no longer connected")
                self._events.add(kind, text, actor=actor[0])

    def _on_program(self, request: Request) -> None:
        request.reply(self.publisher.program(keys.last_chunk(request.key)))

    def _on_join(self, request: Request) -> None:
        name = keys.last_chunk(request.key)
        request.reply(self._joins.join(name, request.payload, time.monotonic()))

    def _on_report(self, request: Request) -> None:
        request.reply(self._joins.report(keys.last_chunk(request.key), request.payload, time.monotonic()))

    def _on_status(self, request: Request) -> None:
        if request.payload != LOOK:
            self._watchdog.heard()
        request.reply(encode(self._status.answer(request)))
