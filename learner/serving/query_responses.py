"""Answers to joins and reports of actors, and to operators: status, events, and the metrics of the whole run.

State that several of the transport's threads read. It decides and encodes the answers; the caller sends them.
"""

import heapq
import logging
import math
import time
from collections.abc import Callable
from typing import TypedDict

from daedalus.learner.serving.actor_state import Actor
from daedalus.learner.serving.fleet import Fleet
from daedalus.learner.serving.run_context import RunContext
from daedalus.learner.serving.waiting_requests import read_request
from daedalus.protocol.codec import ProtocolError, decode, encode, origin_of
from daedalus.protocol.limits import CLIENT_REPORT_LIMITS, JOIN_LIMITS, STATUS_REQUEST_LIMITS
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
    Origin,
    Refusal,
    RunStatus,
    StatusReport,
    Welcome,
)
from daedalus.protocol.releases import own_release
from daedalus.protocol.texts import MAX_NAME, bounded_text
from daedalus.transport.interface import Request


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
    report = actor.report or ClientReport(actor=actor.name, incarnation=actor.incarnation)
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
        deadlines=report.deadlines,
        missed_deadlines=report.missed_deadlines,
        overridden_actions=report.overridden_actions,
        safe_actions=report.safe_actions,
        rollouts_dropped=report.rollouts_dropped,
        safe_reason=report.safe_reason,
        rows=report.rows,
        rollout_seconds=report.rollout_seconds,
        waiting_seconds=report.waiting_seconds,
        round_trip_seconds=report.round_trip_seconds,
        processor_share=report.processor_share,
        memory_bytes=report.memory_bytes,
        silence_limit_seconds=actor.silence_limit,
        drained_by=actor.drained_by,
    )


class StatusResponses:
    """Answers to the queries for the status of one learner."""

    def __init__(self, context: RunContext, status: Callable[[], RunStatus]) -> None:
        """`status` returns the status with the first page of actors; it is called with the lock held."""
        self._context, self._status = context, status

    def answer(self, request: Request) -> Message:
        """Return the status, or what the payload requests."""
        context, epoch = self._context, self._context.learner_epoch
        if not request.size:
            with context.lock:
                return StatusReport(status=self._status())
        message = read_request(request.payload, STATUS_REQUEST_LIMITS, ActorsRequest, EventsRequest, MetricsRequest)
        match message:
            case ActorsRequest():
                with context.lock:
                    actors = page(context.fleet, message.after, time.monotonic())
                return ActorsReport(page=ActorsPage(learner_epoch=epoch, actors=actors))
            case EventsRequest():
                events = context.events.report()
                return EventsReport(page=EventsPage(run=context.name, learner_epoch=epoch, events=events))
            case MetricsRequest():
                return context.history.page(context.name, epoch, message.first)
            case Refusal():
                return message


class JoinResponses:
    """Encoded answers to the Joins and the reports of actors."""

    def __init__(self, context: RunContext) -> None:
        self._context, self._spec = context, context.spec.for_actors()
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
        message, fleet = _read_join(name, data), self._context.fleet
        if isinstance(message, Join) and self._ending is not None:
            return encode(self._ending)
        origin = message.origin if isinstance(message, Join) else origin_of(data, JOIN_LIMITS)
        with self._context.lock:
            before = fleet.incarnation_number(name)
            refusal = message if isinstance(message, Refusal) else fleet.join(message, now)
            if refusal is None:
                self._context.lock.notify_all()
            else:
                fleet.refused_joins.add(name, origin, refusal.reason, now)
                self.postponed_at = now if refusal.code == "name_taken" else self.postponed_at
            seed, epsilon = fleet.seed_for(name, self._context.start_version), fleet.epsilon_for(name)
            is_new = fleet.incarnation_number(name) != before
            order = None if fleet.spaces is None else fleet.spaces.order
        if refusal is not None:
            self.preparing = "" if self.preparing == name else self.preparing
            self._add_refusal(name, origin, refusal)
            return encode(refusal)
        if is_new and isinstance(message, Join) and message.spaces is not None:
            text = f"joined with {message.environments} environments{_where(origin)}"
            self._context.events.add("joined", text, actor=name)
        self.preparing = self.preparing or name
        welcome = Welcome(
            run=self._context.name,
            learner_epoch=self._context.learner_epoch,
            seed=seed,
            epsilon=epsilon,
            spec=self._spec,
            software=own_release(),
            order=order,
        )
        return encode(welcome)

    def report(self, name: str, data: bytes, now: float) -> bytes:
        """Return the answer to the encoded ClientReport of an actor.

        `name` is that in the key of the query, `now` the time on the monotonic clock, in seconds.
        """
        message = read_request(data, CLIENT_REPORT_LIMITS, ClientReport)
        if isinstance(message, Refusal):
            return encode(message)
        with self._context.lock:
            refusal = self._context.fleet.report(name, message, now)
        return encode(refusal or Acknowledgement(verdict="accepted"))

    def _add_refusal(self, name: str, origin: Origin, refusal: Refusal) -> None:
        kind: EventKind = "failed" if refusal.code == "failed" else "refused"
        level = logging.INFO if refusal.code == "name_taken" else logging.WARNING  # that actor asks again
        text = f"{kind}{_where(origin)}: {refusal.reason}"
        self._context.events.add(kind, text, actor=name, cause=refusal.reason, level=level)

    def end(self, *, finished: bool) -> None:
        """Refuse later joins."""
        if finished:
            self._ending = Refusal(code="finished", reason="the run is over")
        else:
            self._ending = Refusal(code="not_ready", reason="the learner is stopping")


def _read_join(name: str, data: bytes) -> Join | Refusal:
    """Return the Join that was sent on the key of an actor, or the Refusal of what is none."""
    try:
        message = decode(data, JOIN_LIMITS)
    except ProtocolError as error:
        return Refusal(code="mismatch", reason=str(error), software=own_release())
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
