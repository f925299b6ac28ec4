"""The rollouts in flight to a learner: which to send when, and what each acknowledgement means. Pure state."""

import math
from collections import Counter
from dataclasses import dataclass, field

from daedalus.protocol.messages import Acknowledgement
from daedalus.protocol.texts import MAX_ANSWER_TEXT, bounded_text

_BUSY_SECONDS = 0.005  # before the first retry after `busy`; doubles with each
_LOST_SECONDS = 0.1  # before the first retry without any answer; doubles with each
_MAX_RETRY_SECONDS = 0.5
# After so many `busy` in a row, 4 s in all, back off further: many actors share this learner.
_MANY_ATTEMPTS, _MAX_BUSY_SECONDS = 14, 4.0
_MAX_ATTEMPTS = 20  # counted no further, so that 2**attempts stays small


@dataclass(slots=True)
class _InFlight:
    payload: bytes
    attempts: int = 0
    send_at: float | None = 0.0  # None while an acknowledgement is awaited
    sent_at: float = 0.0


@dataclass(slots=True)
class InFlightRollouts:
    """Up to `window` rollouts, by sequence number, from collection until their final acknowledgement.

    No lock: the owner guards it, because acknowledgements arrive on the transport's threads.
    """

    window: int
    rollouts: dict[int, _InFlight] = field(default_factory=dict)
    verdicts: Counter[str] = field(default_factory=Counter)  # of all acknowledgements
    newest_version: int = 0  # the newest policy version in any acknowledgement
    fastest_answer: float = math.inf  # seconds: the link's own latency; slower answers also waited at the learner
    last_was_rejected: bool = False  # whether the last final acknowledgement was a rejection
    rejections_in_a_row: int = 0  # among the last final acknowledgements
    ended_by: str = ""  # the verdict that ended the session: "fenced", "quarantined", "finished" or "drained"
    reason: str = ""  # in the last final acknowledgement

    @property
    def has_room(self) -> bool:
        """Whether one more rollout may be collected and sent."""
        return self.has_room_for(1)

    def has_room_for(self, count: int) -> bool:
        """Return whether `count` more rollouts may be collected and sent."""
        return len(self.rollouts) + count <= self.window

    def size_window(self, collect_seconds: float, least: int, most: int) -> None:
        """Size the in-flight window to the link's latency: more rollouts would only grow stale at the learner.

        Args:
          collect_seconds: the time it takes to collect one rollout.
          least, most: bounds of the window.
        """
        needed = self.fastest_answer / max(collect_seconds, 1e-9)
        self.window = most if needed > most - 1 else max(least, 1 + math.ceil(needed))

    def add(self, sequence: int, payload: bytes) -> None:
        """Add an encoded rollout, due at once."""
        self.rollouts[sequence] = _InFlight(payload)

    def resend_all(self) -> None:
        """Make every rollout due again: acknowledgements may have been lost with a connection."""
        self.ended_by, self.reason, self.last_was_rejected = "", "", False
        for rollout in self.rollouts.values():
            rollout.send_at, rollout.attempts = 0.0, 0

    def take_due(self, now: float) -> list[tuple[int, bytes]]:
        """Return the rollouts to send now, oldest first; each is awaited until `acknowledge`."""
        ready = []
        for sequence, rollout in self.rollouts.items():
            if rollout.send_at is not None and rollout.send_at <= now:
                rollout.send_at, rollout.sent_at = None, now
                ready.append((sequence, rollout.payload))
        return ready

    def next_due(self) -> float | None:
        """Return the time at which the next rollout is due, or None if all are awaited."""
        times = [rollout.send_at for rollout in self.rollouts.values() if rollout.send_at is not None]
        return min(times, default=None)

    def acknowledge(self, sequence: int, answer: Acknowledgement | None, now: float) -> None:
        """Apply the answer to one rollout; None means that no answer came and the rollout is sent again.

        Sending twice is safe: the learner trains on each identity at most once.
        """
        rollout = self.rollouts.get(sequence)
        if rollout is None:
            return
        if answer is not None:
            self.newest_version = max(self.newest_version, answer.policy_version)
            self.verdicts[answer.verdict] += 1
            self.fastest_answer = min(self.fastest_answer, now - rollout.sent_at)
        if answer is None or answer.verdict == "busy":
            rollout.send_at = now + _retry_delay(rollout.attempts, lost=answer is None)
            rollout.attempts = min(rollout.attempts + 1, _MAX_ATTEMPTS)
            return
        del self.rollouts[sequence]
        self.last_was_rejected = answer.verdict == "rejected"
        self.rejections_in_a_row = self.rejections_in_a_row + 1 if self.last_was_rejected else 0
        self.reason = bounded_text(answer.reason, MAX_ANSWER_TEXT)
        if answer.verdict in ("fenced", "quarantined", "finished", "drained"):
            self.ended_by = answer.verdict


def _retry_delay(attempts: int, *, lost: bool) -> float:
    """Return the seconds before a rollout is sent again after so many earlier attempts."""
    first, longest = (_LOST_SECONDS, _MAX_RETRY_SECONDS) if lost else (_BUSY_SECONDS, _MAX_BUSY_SECONDS)
    return min(first * 2**attempts, _MAX_RETRY_SECONDS * 2 ** max(attempts - _MANY_ATTEMPTS, 0), longest)
