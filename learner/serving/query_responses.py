"""Answers to queries for joins, the program and the newest snapshot.

State that several of the transport's threads read. It decides and encodes the answers; the caller sends them.
"""

import logging
import math
import threading

from daedalus.learner.serving.events import EventLog
from daedalus.learner.serving.fleet import Fleet
from daedalus.learner.serving.requests import read_request
from daedalus.protocol.codec import ProtocolError, decode, encode, origin_of
from daedalus.protocol.limits import CLIENT_REPORT_LIMITS, JOIN_LIMITS
from daedalus.protocol.messages import Acknowledgement, ClientReport, EventKind, Join, Origin, Program, Refusal, Welcome
from daedalus.protocol.spec import ActorSpec
from daedalus.protocol.texts import MAX_NAME, bounded_text


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
