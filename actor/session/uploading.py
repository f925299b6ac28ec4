"""What an actor uploads: rollouts or their gradients, until their final acknowledgement, and reports."""

import contextlib
import math
from collections import Counter, deque
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Protocol

import numpy as np

from daedalus.actor.errors import ActorError, ActorRefusedError, LearnerLostError
from daedalus.actor.session.conversation import Query, RunOverError, drained
from daedalus.policy.user_modules import UserModuleError, UserModules
from daedalus.protocol import keys
from daedalus.protocol.codec import ProtocolError, decode, encode
from daedalus.protocol.limits import ACKNOWLEDGEMENT_LIMITS
from daedalus.protocol.messages import Acknowledgement, ClientReport
from daedalus.protocol.spaces import Spaces
from daedalus.protocol.spec import ActorSpec, UnsupportedRunError
from daedalus.protocol.texts import MAX_ANSWER_TEXT, bounded_text
from daedalus.protocol.uploads import Rollout, Upload

_ACKNOWLEDGEMENT_SECONDS = 30.0  # a saturated learner answers late
# Between two reports: of a client, whose counts a person watches, and of another actor. And for the answer to one.
CLIENT_PAUSE_SECONDS, ACTOR_PAUSE_SECONDS, _REPORT_ANSWER_SECONDS = 2.0, 5.0, 5.0
_SMOOTHED_ROLLOUTS, _ROUND_TRIPS = 4, 4  # newest ones that the durations in a report are of
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
    """Up to `window` rollouts, by sequence number, from collection until their final acknowledgement."""

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


class Uploads:
    """The upload of rollouts to one learner after the other. State without threads, I/O or clock."""

    def __init__(self, actor: str, on_heard: Callable[[float], None]) -> None:
        """`on_heard` is called with the time of each message of the learner."""
        self._actor, self._on_heard = actor, on_heard
        self.run = ""  # the name of the learner's run
        self.in_flight = InFlightRollouts(window=1)

    def begin(self, run: str, window: int) -> None:
        """Begin with a learner that has no rollouts of this actor yet; keep up to `window` in flight."""
        self.run, self.in_flight = run, InFlightRollouts(window)

    def resume(self) -> None:
        """Continue with the same learner after the network failed."""
        self.in_flight.resend_all()

    def take_due(self, now: float) -> list[Query]:
        """Return the queries of all rollouts that are due, for the first time or again."""
        in_flight, key = self.in_flight, keys.rollouts(self.run, self._actor)
        return [
            Query(key, payload, _ACKNOWLEDGEMENT_SECONDS, partial(self._on_answer, in_flight, sequence))
            for sequence, payload in in_flight.take_due(now)
        ]

    def check(self) -> None:
        """Raise if a verdict ended the session.

        Raises RunOverError if the run or the actor is over, ActorRefusedError in quarantine, and LearnerLostError if
        the learner does not accept rollouts of this learner epoch any more.
        """
        self.check_over()
        if self.in_flight.ended_by == "fenced":
            raise LearnerLostError

    def check_over(self) -> None:
        """Raise as `check` does, unless the actor may join again."""
        ended_by = self.in_flight.ended_by
        if ended_by == "quarantined":
            reason = self.in_flight.reason
            raise ActorRefusedError(
                f"the learner quarantined this actor: {reason}; fix the cause and restart the actor"
            )
        if ended_by == "finished":
            raise RunOverError("the run is over", finished=True)
        if ended_by == "drained":
            raise drained(self.in_flight.reason)

    def _on_answer(self, in_flight: InFlightRollouts, sequence: int, data: bytes | None, now: float) -> None:
        """Receive an answer, or None without one."""
        answer = None
        if data is not None:
            self._on_heard(now)
            with contextlib.suppress(ProtocolError):
                answer = decode(data, ACKNOWLEDGEMENT_LIMITS)
        in_flight.acknowledge(sequence, answer if isinstance(answer, Acknowledgement) else None, now)


class Pace:
    """How an actor spends its time: rows, and durations of the newest rollouts. All times are in seconds."""

    def __init__(self) -> None:
        self.rows = 0  # that have begun
        self._rollout_length = 0  # T
        self._began, self._begun_rows = 0.0, 0  # of the newest rollout
        self._row_at = 0.0  # of the newest row
        self._ended: float | None = None  # when the newest rollout was complete; None before, or in a rollout
        self._played = self._waited = 0.0  # in the rollouts since the last measurement
        self._rollouts = 0
        self._rollout_seconds = self._waiting_seconds = 0.0  # means over the newest rollouts

    def join(self, rollout_length: int) -> None:
        """Begin with a learner; the wait for it does not count."""
        self._rollout_length, self._ended = rollout_length, None

    def begin_rollout(self, now: float) -> None:
        """Note that a rollout begins."""
        if self._ended is not None:
            self._waited += now - self._ended
        self._began, self._begun_rows, self._ended = now, self.rows, None

    def begin_row(self, now: float) -> None:
        """Note that a row begins."""
        self.rows += 1
        self._row_at = now

    def end_rollout(self, now: float) -> None:
        """Note that a rollout is complete and encoded."""
        self._played += now - self._began
        self._rollouts += 1
        self._ended = now

    def added_to(self, report: ClientReport, now: float) -> ClientReport:
        """Return a report with the rows and durations until now. A client counts its rows itself."""
        if report.rows > self.rows:
            self.rows, self._row_at = report.rows, now
        if self._rollouts:
            weight = min(self._rollouts / _SMOOTHED_ROLLOUTS, 1.0) if self._rollout_seconds else 1.0
            self._rollout_seconds += weight * (self._played / self._rollouts - self._rollout_seconds)
            self._waiting_seconds += weight * (self._waited / self._rollouts - self._waiting_seconds)
            self._played, self._waited, self._rollouts = 0.0, 0.0, 0
        waits = 0.0 if self._ended is None else now - self._ended
        return replace(
            report,
            rows=self.rows,
            rollout_seconds=self._rollout_seconds or self._expected,
            waiting_seconds=max(self._waiting_seconds, waits),
        )

    @property
    def rows_played(self) -> int:
        """Rows of the newest rollout that are complete."""
        return max(self.rows - self._begun_rows - 1, 0)

    @property
    def _expected(self) -> float:
        """How long the first rollout will take, by its rows so far; 0 before two of them."""
        rows = self.rows_played
        return (self._row_at - self._began) / rows * self._rollout_length if rows > 0 else 0.0


class Reports:
    """What an actor reports about itself, for the status: reports to one learner after the other."""

    def __init__(self, report: Callable[[], ClientReport], pause: float = CLIENT_PAUSE_SECONDS) -> None:
        """`report` returns the counts so far; `pause` is the time between two reports, in seconds."""
        self._report, self._pause = report, pause
        self.usage: Callable[[], tuple[float, int]] = lambda: (0.0, 0)  # of the process: see UsageMeter
        self._sent: ClientReport | None = None
        self._round_trips: deque[float] = deque(maxlen=_ROUND_TRIPS)
        self.next_at = 0.0

    def begin(self) -> None:
        """Begin with another learner, which knows no counts."""
        self._sent, self.next_at = None, 0.0
        self._round_trips.clear()

    def take_due(self, run: str, now: float, *, repeats: bool = False) -> list[Query]:
        """Return a report, if the last one was a while ago and the counts have changed; `repeats`: if not, too."""
        if now < self.next_at:
            return []
        self.next_at = now + self._pause
        report = self._report()
        if report == self._sent and not repeats:
            return []
        self._sent = report
        processor_share, memory_bytes = self.usage()
        # The shortest: the learner's process may be busy for a moment.
        round_trip = min(self._round_trips, default=0.0)
        timed = replace(
            report, round_trip_seconds=round_trip, processor_share=processor_share, memory_bytes=memory_bytes
        )
        on_answer = partial(self._on_answer, now)
        return [Query(keys.reports(run, report.actor), encode(timed), _REPORT_ANSWER_SECONDS, on_answer)]

    def _on_answer(self, asked_at: float, data: bytes | None, now: float) -> None:
        if data is None:
            self._sent = None  # a report that is lost is sent again later
        else:
            self._round_trips.append(now - asked_at)


class UploadMaker(Protocol):
    """Maker of the messages that an actor uploads in one session."""

    def load(self, weights: dict[str, np.ndarray]) -> None:
        """Use the weights of a snapshot for the next rollouts. Raises PolicyError if they do not fit."""
        ...

    def compute(self, rollout: Rollout) -> Upload:
        """Return what to upload of the next rollout."""
        ...


class RolloutUploadMaker:
    """UploadMaker of the rollouts themselves."""

    def load(self, weights: dict[str, np.ndarray]) -> None:
        """See UploadMaker. Rollouts need no weights."""

    def compute(self, rollout: Rollout) -> Upload:
        """See UploadMaker."""
        return rollout


def make_upload_maker(spec: ActorSpec, spaces: Spaces, modules: UserModules) -> UploadMaker:
    """Return what makes the uploads that a run asks for. Only gradients import torch.

    `modules` may be imported for the network and the algorithm. Raises ActorError if the actor cannot compute
    gradients.
    """
    if not spec.uploads_gradients:
        return RolloutUploadMaker()
    try:
        learning = spec.learning_settings
        modules.check(learning.user_modules)
        from daedalus.algorithms.rollout_gradients import RolloutGradients
        from daedalus.policy.user_modules import NetworkError
        from daedalus.protocol.algorithms import AlgorithmError
    except (UnsupportedRunError, UserModuleError) as error:
        raise ActorError(str(error)) from None
    except ModuleNotFoundError as error:
        if (error.name or "").partition(".")[0] != "torch":
            raise
        raise ActorError(
            "this run takes gradients (collection.upload), which an actor computes with torch: install it with "
            "pip install 'daedalus-rl[learner]', or set collection.upload=rollouts"
        ) from None
    try:
        return RolloutGradients(learning, spaces, modules)
    except (AlgorithmError, NetworkError) as error:
        raise ActorError(str(error)) from None
