"""The learner's side of the protocol: joins, presence, status, intake of rollouts, publication of snapshots.

    transport's threads         answer queries immediately, and queue rollouts
    intake thread               rollout_intake.py
    compact snapshot thread     compact_snapshot_server.py
    watchdog thread             session_watchdog.py

The learner's thread takes batches and publishes snapshots. Network threads never wait for an update.
"""

import contextlib
import logging
import threading
import time
from collections.abc import Callable
from types import MappingProxyType

from daedalus.learner.reporting.metrics_rows import MetricsHistory
from daedalus.learner.run.counters import RunCounters
from daedalus.learner.serving.evaluations import EvaluationQueue
from daedalus.learner.serving.events import EventLog
from daedalus.learner.serving.fleet import Fleet
from daedalus.learner.serving.query_responses import Orders, QueryResponses, StatusResponses, read_request
from daedalus.learner.serving.rollout_intake import POLL_SECONDS, RolloutIntake
from daedalus.learner.serving.session_watchdog import LOOK, SessionWatchdog
from daedalus.learner.serving.snapshot_publisher import SnapshotPublisher
from daedalus.learner.serving.upload_checks import Shapes
from daedalus.protocol import keys
from daedalus.protocol.codec import encode
from daedalus.protocol.limits import (
    CLIENT_REPORT_LIMITS,
    EVALUATION_LIMITS,
    JOIN_LIMITS,
    SNAPSHOT_REQUEST_LIMITS,
    STATUS_REQUEST_LIMITS,
    Limits,
)
from daedalus.protocol.messages import Acknowledgement, OrderRequest, Refusal, RunEnded, RunStatus
from daedalus.protocol.spaces import Spaces
from daedalus.protocol.spec import RunSpec
from daedalus.transport.interface import Request, Transport, TransportError

_OTHER_LEARNER_SECONDS = 2.0  # to wait for the answer of another learner of this run
_LEAVE_SECONDS = 5.0  # after the end of the run, for the actors to leave
_ASK_SECONDS = 2.0  # in which an actor asks again that was refused because its name is in use
_REPEAT_SECONDS = 0.5  # between repetitions of the message that the run is over
_START = "`daedalus actor --connect ADDRESS`"
_HINT_SECONDS = 3.0  # without an actor for so long, log how to start one

_logger = logging.getLogger(__name__)


class ActorServer:
    """Server of the actors of one run, from `open` to `close`."""

    def __init__(
        self,
        run: str,
        spec: RunSpec,
        transport: Transport,
        counters: RunCounters,
        status: Callable[[], RunStatus],
        *,
        learner_epoch: int,
        start_version: int,
        spaces: Spaces | None,
        orders: Orders | None = None,
    ) -> None:
        """Construct the server.

        Args:
          run: name of the run.
          spec: specification of the run.
          transport: the network.
          counters: updated by the server; other threads read them under `lock`.
          status: function that returns the status with the first page of actors; called with the lock held.
          learner_epoch: epoch of this learner process.
          start_version: policy version of the checkpoint that the run continues from, else 0.
          spaces: spaces that all actors must have; None: those of the first actor.
          orders: receives the orders of operators, and notes a newer learner; None: nobody carries them out.
        """
        self.lock = threading.Condition()  # guards the fleet, the counters and the state shared with other parts
        self.fleet = Fleet(spec.training.seed, spaces, spec.training.epsilons, spec.collection.envs_per_actor)
        self._run, self._transport, self._epoch = run, transport, learner_epoch
        self._ended, self._ended_at = b"", 0.0  # the encoded RunEnded, after the end
        self._were_cut_off = False  # whether actors were absent at the end that were seen shortly before
        self.events = EventLog()
        self.history = MetricsHistory()
        self._orders = orders or Orders(threading.Event())
        self._status = StatusResponses(run, learner_epoch, status, self.fleet, self.lock, self.events, self.history)
        self._responses = QueryResponses(
            run, spec.for_actors(), learner_epoch, start_version, self.fleet, self.lock, self.events
        )
        start = {"learner_epoch": learner_epoch, "start_version": start_version}
        self.publisher = SnapshotPublisher(
            run, spec, transport, self._responses, self.fleet, self.lock, counters, **start
        )
        self.rollouts = RolloutIntake(
            spec, self.lock, self.fleet, counters, lambda: self.publisher.version, self.events, **start
        )
        self.evaluations = EvaluationQueue()
        self._watchdog = SessionWatchdog(transport, keys.status(run), learner_epoch, self._step_down)

    def open(self) -> None:
        """Start to serve actors. Raises TransportError if another learner serves a run of this name."""
        transport, run, responses = self._transport, self._run, self._responses
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
        self._serve(keys.program(run, "*"), lambda query: query.reply(responses.program(keys.last_chunk(query.key))))
        self._serve(keys.status(run), self._on_status, STATUS_REQUEST_LIMITS)
        self._serve(keys.drain(run, "*"), self._on_drain, STATUS_REQUEST_LIMITS)
        self._serve(keys.reports(run, "*"), self._on_report, CLIENT_REPORT_LIMITS)
        self._serve(keys.orders(run), self._on_order, STATUS_REQUEST_LIMITS)
        self._serve(keys.evaluations(run, "*"), self.evaluations.offer, EVALUATION_LIMITS)
        transport.declare_presence(keys.learner(run))
        # Last, because an actor that has joined uses all other keys.
        self._serve(keys.join(run, "*"), self._on_join, JOIN_LIMITS)
        self._watchdog.open()
        self.events.add("started", f"serving run {run!r}")

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
        with self.lock:
            if self._ended:
                return
            outcome = "finished" if finished else "stopped"
            self._ended = encode(RunEnded(learner_epoch=self._epoch, outcome=outcome, reason=reason))
            self._ended_at = time.monotonic()
            self._were_cut_off = any(
                self._ended_at < actor.last_seen + _LEAVE_SECONDS and not self.fleet.is_present(actor)
                for actor in self.fleet.actors.values()
            )
        self.events.add("ended", reason)
        self._responses.end(self._ended, finished=finished)
        self._publish_end()
        with self.lock:
            self.rollouts.end(finished=finished)
            self.lock.notify_all()
        self.publisher.close()
        self.evaluations.end(reason, finished=finished)
        self._watchdog.close()
        self.rollouts.close()

    def _step_down(self, newer: int) -> None:
        """End this learner, because a newer one of the run answers. Called on the watchdog's thread.

        The server is closed at once: an update may take long, and until then actors would stay here.
        """
        with self.lock:
            if self._ended:
                return
        self._orders.step_down(newer)
        self.close("a newer learner of this run has taken over")
        _logger.warning(
            "a newer learner of run %r answers (epoch %x; this one is %x): this learner steps down, and the run goes "
            "on there. If that is another run, rename one of the two (the last part of --run-dir)",
            self._run,
            newer,
            self._epoch,
        )

    def _publish_end(self) -> None:
        with contextlib.suppress(TransportError):  # the session is being replaced; actors receive a repetition
            self._transport.publish(keys.run_end(self._run), self._ended)

    def await_departures(self, stop: threading.Event) -> None:
        """Wait until all actors have left, at most 5 s, and repeat that the run is over. Call after `close`."""
        repeat_at = self._ended_at + _REPEAT_SECONDS
        while self._expects_actors(time.monotonic()) and not stop.is_set():
            with self.lock:
                self.lock.wait(POLL_SECONDS)
            if time.monotonic() >= repeat_at:
                self._publish_end()
                repeat_at += _REPEAT_SECONDS
        self._publish_end()  # to whoever has just begun to join

    def _expects_actors(self, now: float) -> bool:
        """Return whether an actor may not know of the end yet: it is present, was cut off, or is about to ask again."""
        if now > self._ended_at + _LEAVE_SECONDS:
            return False
        with self.lock:
            return bool(self.fleet.live) or self._were_cut_off or now < self._responses.postponed_at + _ASK_SECONDS

    def await_actor(self, stop: threading.Event, on_wait: Callable[[], None] = lambda: None) -> bool:
        """Wait until an actor has joined, and return whether one has; False if `stop` is set first.

        `on_wait` is called again and again meanwhile.
        """
        hint_at, hinted = time.monotonic() + _HINT_SECONDS, None
        with self.lock:
            while not self.fleet.has_had_actors and not stop.is_set():
                on_wait()
                self.lock.wait(POLL_SECONDS)
                if time.monotonic() > hint_at and hinted != self._responses.preparing:
                    hinted = self._responses.preparing
                    doing = f"{hinted} makes its environments" if hinted else f"start one with {_START}"
                    _logger.info("waiting for the first actor: %s", doing)
            return self.fleet.has_had_actors

    def offer_policy(self, program: bytes, state_size: int, gradient_shapes: Shapes = MappingProxyType({})) -> None:
        """Make the policy program available to actors. See RolloutIntake.expect for the sizes."""
        self.rollouts.expect(state_size, gradient_shapes)
        self.publisher.offer_program(program)
        self.evaluations.open()

    # ----------------------------------------------------------------------------- the transport's threads

    def _on_presence(self, key: str, present: bool) -> None:
        actor = keys.parse_presence(key)
        if actor is not None:
            with self.lock:
                changed = self.fleet.set_present(*actor, present, time.monotonic())
                self.lock.notify_all()
            if changed:
                kind, text = ("joined", "connected again") if present else ("left", "no longer connected")
                self.events.add(kind, text, actor=actor[0])

    def _on_join(self, request: Request) -> None:
        name = keys.last_chunk(request.key)
        request.reply(self._responses.join(name, request.payload, time.monotonic()))

    def _on_report(self, request: Request) -> None:
        request.reply(self._responses.report(keys.last_chunk(request.key), request.payload))

    def _on_drain(self, request: Request) -> None:
        name = keys.last_chunk(request.key)
        with self.lock:
            refusal = self.fleet.drain(name)
        if refusal is None:
            _logger.info("actor %s is drained: it leaves after its current rollout", name)
        request.reply(encode(refusal or Acknowledgement(verdict="accepted")))

    def _on_order(self, request: Request) -> None:
        message = read_request(request.payload, STATUS_REQUEST_LIMITS, OrderRequest)
        if isinstance(message, Refusal):
            request.reply(encode(message))
            return
        _logger.info("an operator orders: %s", message.order)
        self._orders.give(message.order, request)

    def _on_status(self, request: Request) -> None:
        if request.payload != LOOK:
            self._watchdog.heard()
        request.reply(encode(self._status.answer(request)))
