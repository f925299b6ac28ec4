"""Keeps up to `window` rollouts in flight until each is answered for good. State and decisions, no waiting.

The service owns the lock that guards it: answers arrive on the transport's threads.
"""

import math
from collections import Counter
from dataclasses import dataclass, field

from daedalus.protocol.messages import Acknowledgement

_BUSY_SECONDS = 0.005  # first wait after a busy answer; doubles
_LOST_SECONDS = 0.1  # wait after no answer at all
_MAX_WAIT_SECONDS = 0.5
_WEARY, _MAX_WEARY_SECONDS = 14, 4.0  # busy so many times in a row, 4 s in all, it asks less often: many do


@dataclass(slots=True)
class _InFlight:
    payload: bytes
    attempts: int = 0
    send_at: float | None = 0.0  # None while an answer is awaited
    sent_at: float = 0.0


@dataclass(slots=True)
class Uploader:
    """Rollouts that were collected and not yet answered for good, by sequence number."""

    window: int
    in_flight: dict[int, _InFlight] = field(default_factory=dict)
    verdicts: Counter[str] = field(default_factory=Counter)
    newest_version: int = 0  # that any answer told of
    fastest_answer: float = math.inf  # seconds: what the link alone takes, the others waited at the learner as well
    must_replace: bool = False  # the last answer was a rejection: collect another in its place
    refused_in_a_row: int = 0  # of the last answers for good, how many were rejections
    over: str = ""  # "fenced", "quarantined" or "finished" once the learner said so
    reason: str = ""  # that its last rejection gave, or its last word

    @property
    def has_room(self) -> bool:
        """Whether one more may be played, and then sent."""
        return len(self.in_flight) < self.window

    def fit_window(self, play_seconds: float, least: int, most: int) -> None:
        """Has as many under way as are played while the link works: more would only grow old at the learner."""
        needed = self.fastest_answer / max(play_seconds, 1e-9)
        self.window = most if needed > most - 1 else max(least, 1 + math.ceil(needed))

    def add(self, sequence: int, payload: bytes) -> None:
        """Takes in a rollout; it is due at once."""
        self.in_flight[sequence] = _InFlight(payload)

    def send_again(self) -> None:
        """Begins anew with the same rollouts, all of them due: answers may have been lost with a connection."""
        self.over, self.reason, self.must_replace = "", "", False
        for rollout in self.in_flight.values():
            rollout.send_at, rollout.attempts = 0.0, 0

    def due(self, now: float) -> list[tuple[int, bytes]]:
        """Those to send now, oldest first; each is then awaited until `answered`."""
        ready = []
        for sequence, rollout in self.in_flight.items():
            if rollout.send_at is not None and rollout.send_at <= now:
                rollout.send_at, rollout.sent_at = None, now
                ready.append((sequence, rollout.payload))
        return ready

    def next_due(self) -> float | None:
        """When the next of them is due, or None if all are awaited."""
        times = [rollout.send_at for rollout in self.in_flight.values() if rollout.send_at is not None]
        return min(times, default=None)

    def answered(self, sequence: int, answer: Acknowledgement | None, now: float) -> None:
        """Takes in the answer to one; None means that none came, so it is sent again.

        Sending twice is safe: the learner trains on each identity at most once.
        """
        rollout = self.in_flight.get(sequence)
        if rollout is None:
            return
        if answer is not None:
            self.newest_version = max(self.newest_version, answer.policy_version)
            self.verdicts[answer.verdict] += 1
            self.fastest_answer = min(self.fastest_answer, now - rollout.sent_at)
        if answer is None or answer.verdict == "busy":
            rollout.send_at = now + _pause(rollout.attempts, lost=answer is None)
            rollout.attempts = min(rollout.attempts + 1, 20)
            return
        del self.in_flight[sequence]
        self.must_replace = answer.verdict == "rejected"
        self.refused_in_a_row = self.refused_in_a_row + 1 if self.must_replace else 0
        self.reason = answer.reason
        if answer.verdict in ("fenced", "quarantined", "finished"):
            self.over = answer.verdict


def _pause(attempts: int, *, lost: bool) -> float:
    """Seconds until a rollout is sent again that was not taken so many times before."""
    first, longest = (_LOST_SECONDS, _MAX_WAIT_SECONDS) if lost else (_BUSY_SECONDS, _MAX_WEARY_SECONDS)
    return min(first * 2**attempts, _MAX_WAIT_SECONDS * 2 ** max(attempts - _WEARY, 0), longest)
