"""What the learner answers to those who ask: joins, the program, the newest snapshot, the status.

State that several of the transport's threads read; it holds the answers ready and decides, and the service
puts it on the wire.
"""

import threading

from daedalus.learner.serving.fleet import Fleet
from daedalus.protocol.codec import ProtocolError, decode, encode
from daedalus.protocol.limits import JOIN_LIMITS
from daedalus.protocol.messages import Join, Program, Refusal, Welcome
from daedalus.protocol.spec import RunSpec


class QueryResponses:
    """Answers, as bytes, to the queries that are not rollouts. The lock that it is given guards the fleet."""

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
        self._snapshot = encode(Refusal(code="not_ready", reason="the learner has no policy yet"))
        self._program: Program | None = None
        self._encoded_program = b""
        self._over = False

    def join(self, data: bytes, now: float) -> bytes:
        """The answer to a Join: Welcome, or Refusal with the reason. Wakes who waits for actors."""
        try:
            message = decode(data, JOIN_LIMITS)
        except ProtocolError as error:
            return encode(Refusal(code="mismatch", reason=str(error)))
        if not isinstance(message, Join):
            return encode(Refusal(code="malformed", reason="only actors that ask to join belong here"))
        if self._over:
            return encode(Refusal(code="finished", reason="the run is over"))
        with self._lock:
            refusal = self._fleet.join(message, now)
            if refusal is not None:
                return encode(refusal)
            seed = self._fleet.seed_for(message.actor, self._start_version)
            self._lock.notify_all()
        return encode(Welcome(run=self._run, learner_epoch=self._epoch, seed=seed, spec=self._spec))

    def offer_program(self, program: Program) -> None:
        """Has the run's program ready for those who ask for it."""
        self._encoded_program, self._program = encode(program), program

    def program(self, program_hash: str) -> bytes:
        """The answer to a query for a program, or for the one that is played (`*`)."""
        if self._program is None or program_hash not in ("*", self._program.hash):
            return encode(Refusal(code="unknown", reason=f"there is no program {program_hash[:64]!r}"))
        return self._encoded_program

    def offer_snapshot(self, encoded: bytes) -> None:
        """Has the newest snapshot ready, as the bytes that were published."""
        self._snapshot = encoded

    def close(self, run_ended: bytes) -> None:
        """Lets nobody in any more, and answers with a run_ended where there were snapshots."""
        self._over = True
        self._snapshot = run_ended

    def snapshot(self) -> bytes:
        """The answer to a query for the newest snapshot."""
        return self._snapshot
