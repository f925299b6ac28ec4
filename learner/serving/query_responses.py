"""Answers to queries for joins, the program and the newest snapshot.

State that several of the transport's threads read. It decides and encodes the answers; the caller sends them.
"""

import math
import threading

from daedalus.learner.serving.fleet import Fleet
from daedalus.protocol.codec import ProtocolError, decode, encode
from daedalus.protocol.limits import JOIN_LIMITS
from daedalus.protocol.messages import Join, Program, Refusal, Welcome
from daedalus.protocol.spec import RunSpec


class QueryResponses:
    """Encoded answers to queries that do not carry rollouts. `lock` guards the fleet."""

    def __init__(
        self,
        run: str,
        spec: RunSpec,
        learner_epoch: int,
        start_version: int,
        fleet: Fleet,
        lock: threading.Condition,
    ) -> None:
        self._run = run
        self._spec = spec
        self._epoch = learner_epoch
        self._start_version = start_version
        self._fleet = fleet
        self._lock = lock
        # The answer to queries for the newest snapshot, and its version if it is a snapshot.
        self._snapshot: tuple[bytes, int | None] = (_refuse("the learner has no policy yet"), None)
        self._unchanged = _refuse("the actor holds the newest snapshot")
        self._program: Program | None = None
        self._encoded_program = b""
        self._ending: Refusal | None = None  # of joins after the end
        self.postponed_at = -math.inf  # the last time that an actor was refused which will ask again

    def join(self, name: str, data: bytes, now: float) -> bytes:
        """Return the answer to a Join: a Welcome, or a Refusal with the reason. Notifies the lock after a Welcome.

        Args:
          name: name of the actor in the key of the query, which access control has checked.
          data: the encoded message.
          now: time on the monotonic clock, in seconds.
        """
        try:
            message = decode(data, JOIN_LIMITS)
        except ProtocolError as error:
            return encode(Refusal(code="mismatch", reason=str(error)))
        if not isinstance(message, Join):
            return encode(Refusal(code="malformed", reason="expected a Join message"))
        if message.actor != name:
            reason = f"the Join is from {message.actor[:64]!r}, but was sent on the key of {name!r}"
            return encode(Refusal(code="malformed", reason=reason))
        if self._ending is not None:
            return encode(self._ending)
        with self._lock:
            refusal = self._fleet.join(message, now)
            if refusal is not None:
                if refusal.code == "name_taken":
                    self.postponed_at = now
                return encode(refusal)
            seed = self._fleet.seed_for(message.actor, self._start_version)
            self._lock.notify_all()
        return encode(Welcome(run=self._run, learner_epoch=self._epoch, seed=seed, spec=self._spec))

    def offer_program(self, program: Program) -> None:
        """Set the run's program, the answer to later queries."""
        self._encoded_program, self._program = encode(program), program

    def program(self, program_hash: str) -> bytes:
        """Return the answer to a query for the program with a hash, or for the current program (`*`)."""
        if self._program is None or program_hash not in ("*", self._program.hash):
            return encode(Refusal(code="unknown", reason=f"no program with hash {program_hash[:64]!r}"))
        return self._encoded_program

    def offer_snapshot(self, encoded: bytes, policy_version: int) -> None:
        """Set the newest snapshot, as the bytes that were published."""
        self._snapshot = encoded, policy_version

    def end(self, run_ended: bytes, *, finished: bool) -> None:
        """Refuse later joins, and answer queries for snapshots with `run_ended`, an encoded RunEnded."""
        self._snapshot = run_ended, None
        if finished:
            self._ending = Refusal(code="finished", reason="the run is over")
        else:
            self._ending = Refusal(code="not_ready", reason="the learner is stopping")

    def snapshot(self, held_version: int | None = None) -> bytes:
        """Return the answer to a query for the newest snapshot by an actor that holds `held_version`."""
        encoded, version = self._snapshot
        return self._unchanged if version is not None and version == held_version else encoded


def _refuse(reason: str) -> bytes:
    return encode(Refusal(code="not_ready", reason=reason))
