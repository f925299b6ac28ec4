"""Sends rollouts to a learner and receives their acknowledgements, on the transport's threads. Never waits."""

import time

from daedalus.actor.session.in_flight_rollouts import InFlightRollouts
from daedalus.actor.session.learner_presence import LearnerPresence
from daedalus.actor.session.state_lock import StateLock
from daedalus.protocol import keys
from daedalus.protocol.codec import ProtocolError, decode
from daedalus.protocol.limits import ACKNOWLEDGEMENT_LIMITS
from daedalus.protocol.messages import Acknowledgement
from daedalus.transport.interface import QuerySender, TransportError

_ACKNOWLEDGEMENT_SECONDS = 30.0  # a saturated learner answers late


class UploadSession:
    """The upload of rollouts to one learner after the other.

    The lock guards `in_flight`. Its methods are for the actor's thread.
    """

    def __init__(self, sender: QuerySender, actor: str, presence: LearnerPresence, lock: StateLock) -> None:
        self._sender, self._actor, self._presence, self._lock = sender, actor, presence, lock
        self.run = ""  # the name of the learner's run
        self.in_flight = InFlightRollouts(window=1)

    def begin(self, run: str, window: int) -> None:
        """Begin with a learner that has no rollouts of this actor yet; keep up to `window` in flight."""
        with self._lock:
            self.run, self.in_flight = run, InFlightRollouts(window)

    def resume(self) -> None:
        """Continue with the same learner after the network failed."""
        with self._lock:
            self.in_flight.resend_all()

    def size_window(self, collect_seconds: float, least: int, most: int) -> None:
        """See InFlightRollouts."""
        with self._lock:
            self.in_flight.size_window(collect_seconds, least, most)

    def send(self, sequence: int, payload: bytes) -> None:
        """Send an encoded rollout; `send_due` repeats it until its final acknowledgement."""
        with self._lock:
            self.in_flight.add(sequence, payload)
        self.send_due()

    def send_due(self) -> None:
        """Send every rollout that is due, for the first time or again."""
        in_flight = self.in_flight
        with self._lock:
            due = in_flight.take_due(time.monotonic())
        for sequence, payload in due:
            try:
                self._sender.query_async(
                    keys.rollouts(self.run, self._actor),
                    payload,
                    timeout=_ACKNOWLEDGEMENT_SECONDS,
                    on_answer=lambda answer, sequence=sequence: self._on_answer(in_flight, sequence, answer),
                )
            except TransportError:
                self._on_answer(in_flight, sequence, None)

    def clear_rejection(self) -> None:
        """Forget that the last rollout was rejected: the actor is about to collect its replacement."""
        with self._lock:
            self.in_flight.last_was_rejected = False

    @property
    def rejections(self) -> tuple[int, str]:
        """How many of the last final acknowledgements in a row were rejections, and the reason in the last one."""
        with self._lock:
            return self.in_flight.rejections_in_a_row, self.in_flight.reason

    def _on_answer(self, in_flight: InFlightRollouts, sequence: int, data: bytes | None) -> None:
        """Receive an answer, or None without one. Called on the transport's threads."""
        try:
            answer = None if data is None else decode(data, ACKNOWLEDGEMENT_LIMITS)
        except ProtocolError:
            answer = None
        with self._lock:
            if data is not None:
                self._presence.heard()
            acknowledgement = answer if isinstance(answer, Acknowledgement) else None
            in_flight.acknowledge(sequence, acknowledgement, time.monotonic())
            self._lock.announce_change()
