"""Answers to queries for joins, the program and the newest snapshot.

State that several of the transport's threads read. It decides and encodes the answers; the caller sends them.
"""

import heapq
import logging
import math
import threading
import time
from collections.abc import Callable
from typing import TypedDict, TypeVar

from daedalus.learner.reporting.metrics_rows import MetricsHistory
from daedalus.learner.serving.events import EventLog
from daedalus.learner.serving.fleet import Actor, Fleet
from daedalus.protocol.codec import ProtocolError, decode, encode, origin_of
from daedalus.protocol.limits import CLIENT_REPORT_LIMITS, JOIN_LIMITS, STATUS_REQUEST_LIMITS, Limits
from daedalus.protocol.messages import (
    PAGE_ACTORS,
    Acknowledgement,
    ActorsPage,
    ActorsReport,
    ActorsRequest,
    ActorStatus,
    ClientReport,
    EventKind,
    EventsPage,
    EventsReport,
    EventsRequest,
    Join,
    Message,
    MetricsRequest,
    Order,
    Origin,
    Program,
    Refusal,
    RunStatus,
    StatusReport,
    Welcome,
)
from daedalus.protocol.spec import ActorSpec
from daedalus.protocol.texts import MAX_NAME, bounded_text
from daedalus.transport.interface import Request

Kind = TypeVar("Kind")


def read_request(payload: bytes, limits: Limits, *kinds: type[Kind]) -> Kind | Refusal:
    """Return the message of a query, or the Refusal of what is no message of these kinds."""
    try:
        message = decode(payload, limits)
    except ProtocolError as error:
        return Refusal(code="malformed", reason=str(error))
    if not isinstance(message, kinds):
        expected = " or ".join(kind.__name__ for kind in kinds)
        return Refusal(code="malformed", reason=f"expected {expected}, and not {type(message).__name__}")
    return message


class FleetTotals(TypedDict):
    """Fields of RunStatus that are over all actors. The counts include forgotten actors."""

    actors_alive: int
    actors_quarantined: int
    actors_gone: int
    rollouts_missed: int
    busy_answers: int


def totals(fleet: Fleet) -> FleetTotals:
    """Return the totals over all actors."""
    actors = fleet.actors.values()
    present = [actor for actor in actors if fleet.is_present(actor)]
    quarantined = sum(bool(actor.quarantined) for actor in present)
    return {
        "actors_alive": len(present) - quarantined,
        "actors_quarantined": quarantined,
        "actors_gone": len(actors) - len(present),
        "rollouts_missed": min(fleet.forgotten_missed + sum(actor.missed for actor in actors), 2**53),
        "busy_answers": fleet.forgotten_busy + sum(actor.busy for actor in actors),
    }


def page(fleet: Fleet, after: str, now: float) -> tuple[ActorStatus, ...]:
    """Return the status of the actors with the first names after `after`, sorted by name.

    `now` is on the monotonic clock, in seconds.
    """
    names = heapq.nsmallest(PAGE_ACTORS, (name for name in fleet.actors if name > after))
    return tuple(_actor_status(fleet, fleet.actors[name], now) for name in names)


def _actor_status(fleet: Fleet, actor: Actor, now: float) -> ActorStatus:
    client = actor.client or ClientReport(actor=actor.name, incarnation=actor.incarnation)
    return ActorStatus(
        actor=actor.name,
        host=actor.origin.host,
        software=actor.origin.software,
        address=actor.origin.address,
        alive=fleet.is_present(actor),
        quarantined=actor.quarantined,
        lives=actor.incarnations,
        seconds_since_seen=max(now - actor.last_seen, 0.0),
        environments=actor.environments,
        epsilon=actor.epsilon,
        env_steps=actor.env_steps,
        env_steps_per_second=actor.env_steps_per_second,
        rollouts_accepted=actor.accepted,
        rollouts_rejected=dict(actor.rejected),
        rollouts_missed=actor.missed,
        busy_answers=actor.busy,
        policy_lag=actor.policy_lag,
        compact_snapshots=actor.compact_snapshots,
        bytes_up_per_hour=actor.bytes_up_per_hour,
        bytes_down_per_hour=actor.bytes_down_per_hour,
        deadlines=client.deadlines,
        missed_deadlines=client.missed_deadlines,
        overridden_actions=client.overridden_actions,
        safe_actions=client.safe_actions,
        rollouts_dropped=client.rollouts_dropped,
        safe_reason=client.safe_reason,
    )


class StatusResponses:
    """Answers to the queries for the status of one learner."""

    def __init__(
        self,
        run: str,
        learner_epoch: int,
        status: Callable[[], RunStatus],
        fleet: Fleet,
        lock: threading.Condition,
        events: EventLog,
        history: MetricsHistory,
    ) -> None:
        """`status` returns the status with the first page of actors; it is called with `lock` held."""
        self._run, self._epoch, self._status = run, learner_epoch, status
        self._fleet, self._lock, self._events, self._history = fleet, lock, events, history

    def answer(self, request: Request) -> Message:
        """Return the status, or what the payload requests."""
        if not request.size:
            with self._lock:
                return StatusReport(status=self._status())
        message = read_request(request.payload, STATUS_REQUEST_LIMITS, ActorsRequest, EventsRequest, MetricsRequest)
        match message:
            case ActorsRequest():
                with self._lock:
                    actors = page(self._fleet, message.after, time.monotonic())
                return ActorsReport(page=ActorsPage(learner_epoch=self._epoch, actors=actors))
            case EventsRequest():
                events = self._events.report()
                return EventsReport(page=EventsPage(run=self._run, learner_epoch=self._epoch, events=events))
            case MetricsRequest():
                return self._history.page(self._run, self._epoch, message.first)
            case Refusal():
                return message


_ANSWER_SECONDS = 3.0  # a gateway waits 5 s for its answer
_MOST_WAITING = 16  # requests whose answers wait
_LATER = "not saved yet: the events of the run say when the checkpoint is saved"


class Orders:
    """The orders that were not carried out yet.

    A checkpoint is written beside training. The answer waits until it is saved, for a few seconds at most.
    """

    def __init__(self, stop: threading.Event) -> None:
        """`stop` ends the run."""
        self._stop, self._lock = stop, threading.Lock()
        self._wanted = False
        self._waiting: list[Request] = []
        self.stopped = False  # whether an operator stopped the run
        self.superseded_by: int | None = None  # epoch of a newer learner of the run, for which this one steps down

    def give(self, order: Order, request: Request) -> None:
        """Note an order, which is answered now or when it is carried out. Does not block."""
        if order == "stop":
            self.stopped = True
            self._stop.set()
            request.reply(encode(Acknowledgement(verdict="accepted")))
            return
        with self._lock:
            self._wanted = True
            waits = len(self._waiting) < _MOST_WAITING
            if waits:
                self._waiting.append(request)
        if not waits:
            _answer_later(request)
            return
        timer = threading.Timer(_ANSWER_SECONDS, _answer_later, [request])  # no effect if it is answered by then
        timer.daemon = True
        timer.start()

    def step_down(self, newer: int) -> None:
        """Stop the run here: a learner of it with a newer epoch answers."""
        self.superseded_by = newer
        self._stop.set()

    @property
    def checkpoint_wanted(self) -> bool:
        """Whether a checkpoint was ordered that `take_checkpoint` has not returned."""
        return self._wanted

    def take_checkpoint(self) -> Callable[[bool, str], None]:
        """Take the orders of a checkpoint. Return what answers them: with whether it is saved, and what came of it."""
        with self._lock:
            self._wanted, waiting, self._waiting = False, self._waiting, []

        def answer(is_saved: bool, result: str) -> None:
            accepted = Acknowledgement(verdict="accepted", reason=result)
            message = encode(accepted if is_saved else Refusal(code="failed", reason=result))
            for request in waiting:
                request.reply(message)

        return answer


def _answer_later(request: Request) -> None:
    request.reply(encode(Acknowledgement(verdict="accepted", reason=_LATER)))


class QueryResponses:
    """Encoded answers to queries that do not carry rollouts. `lock` guards the fleet."""

    def __init__(
        self,
        run: str,
        spec: ActorSpec,
        learner_epoch: int,
        start_version: int,
        fleet: Fleet,
        lock: threading.Condition,
        events: EventLog,
    ) -> None:
        self._run = run
        self._spec = spec
        self._epoch = learner_epoch
        self._start_version = start_version
        self._fleet = fleet
        self._lock = lock
        self._events = events
        # The answer to queries for the newest snapshot, and its version if it is a snapshot.
        self._snapshot: tuple[bytes, int | None] = (_refuse("the learner has no policy yet"), None)
        self._unchanged = _refuse("the actor holds the newest snapshot")
        self._program: Program | None = None
        self._encoded_program = b""
        self._ending: Refusal | None = None  # of joins after the end
        self.preparing = ""  # an actor that asked for the specification, and makes its environments
        self.postponed_at = -math.inf  # the last time that an actor was refused which will ask again

    def join(self, name: str, data: bytes, now: float) -> bytes:
        """Return the answer to a Join: a Welcome, or a Refusal with the reason. Notifies the lock after a Welcome.

        Args:
          name: name of the actor in the key of the query, which access control has checked.
          data: the encoded message.
          now: time on the monotonic clock, in seconds.
        """
        message = _read_join(name, data)
        if isinstance(message, Join) and self._ending is not None:
            return encode(self._ending)
        origin = message.origin if isinstance(message, Join) else origin_of(data, JOIN_LIMITS)
        with self._lock:
            before = self._fleet.incarnation_number(name)
            refusal = message if isinstance(message, Refusal) else self._fleet.join(message, now)
            if refusal is None:
                self._lock.notify_all()
            else:
                self._fleet.refused_joins.add(name, origin, refusal.reason, now)
                self.postponed_at = now if refusal.code == "name_taken" else self.postponed_at
            seed, epsilon = self._fleet.seed_for(name, self._start_version), self._fleet.epsilon_for(name)
            is_new = self._fleet.incarnation_number(name) != before
        if refusal is not None:
            self.preparing = "" if self.preparing == name else self.preparing
            self._add_refusal(name, origin, refusal)
            return encode(refusal)
        if is_new and isinstance(message, Join) and message.spaces is not None:
            text = f"joined with {message.environments} environments{_where(origin)}"
            self._events.add("joined", text, actor=name)
        self.preparing = self.preparing or name
        welcome = Welcome(run=self._run, learner_epoch=self._epoch, seed=seed, epsilon=epsilon, spec=self._spec)
        return encode(welcome)

    def report(self, name: str, data: bytes) -> bytes:
        """Return the answer to the encoded ClientReport of an actor. `name` is that in the key of the query."""
        message = read_request(data, CLIENT_REPORT_LIMITS, ClientReport)
        if isinstance(message, Refusal):
            return encode(message)
        with self._lock:
            refusal = self._fleet.report(name, message)
        return encode(refusal or Acknowledgement(verdict="accepted"))

    def _add_refusal(self, name: str, origin: Origin, refusal: Refusal) -> None:
        kind: EventKind = "failed" if refusal.code == "failed" else "refused"
        level = logging.INFO if refusal.code == "name_taken" else logging.WARNING  # that actor asks again
        text = f"{kind}{_where(origin)}: {refusal.reason}"
        self._events.add(kind, text, actor=name, cause=refusal.reason, level=level)

    def offer_program(self, program: Program) -> None:
        """Set the run's program, the answer to later queries."""
        self._encoded_program, self._program = encode(program), program

    def program(self, program_hash: str) -> bytes:
        """Return the answer to a query for the program with a hash, or for the current program (`*`)."""
        if self._program is None or program_hash not in ("*", self._program.hash):
            return encode(Refusal(code="unknown", reason=f"no program with hash {program_hash[:64]!r}"))
        return self._encoded_program

    def offer_snapshot(self, encoded: bytes, policy_version: int) -> None:
        """Set the newest snapshot, as the bytes that were published. After `end` this has no effect."""
        if self._ending is None:
            self._snapshot = encoded, policy_version

    def end(self, run_ended: bytes, *, finished: bool) -> None:
        """Refuse later joins, and answer queries for snapshots with `run_ended`, an encoded RunEnded."""
        if finished:
            self._ending = Refusal(code="finished", reason="the run is over")
        else:
            self._ending = Refusal(code="not_ready", reason="the learner is stopping")
        self._snapshot = run_ended, None

    def snapshot(self, held_version: int | None = None) -> bytes:
        """Return the answer to a query for the newest snapshot by an actor that holds `held_version`."""
        encoded, version = self._snapshot
        return self._unchanged if version is not None and version == held_version else encoded


def _read_join(name: str, data: bytes) -> Join | Refusal:
    """Return the Join that was sent on the key of an actor, or the Refusal of what is none."""
    try:
        message = decode(data, JOIN_LIMITS)
    except ProtocolError as error:
        return Refusal(code="mismatch", reason=str(error))
    if not isinstance(message, Join):
        return Refusal(code="malformed", reason="expected a Join message")
    if message.actor != name:
        reason = f"the Join is from {message.actor[:64]!r}, but was sent on the key of {name[:64]!r}"
        return Refusal(code="malformed", reason=reason)
    if message.failure:
        return Refusal(code="failed", reason=bounded_text(message.failure))
    return message


def _where(origin: Origin) -> str:
    """Return host and software for a person, or an empty text if both are unknown."""
    where = ", ".join(filter(None, (bounded_text(origin.host, MAX_NAME), bounded_text(origin.software, MAX_NAME))))
    return f" ({where})" if where else ""


def _refuse(reason: str) -> bytes:
    return encode(Refusal(code="not_ready", reason=reason))
