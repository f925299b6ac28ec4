"""State of one actor in the learner: its counts, which of its rollouts have arrived, and its faults. No I/O."""

from collections import Counter
from dataclasses import dataclass, field

from daedalus.protocol.messages import UNKNOWN, ClientReport, Origin
from daedalus.protocol.texts import bounded_text

_REORDERING = 1024  # largest distance of sequence numbers that arrive out of order


@dataclass(slots=True)
class SequenceWindow:
    """Received sequence numbers of one incarnation. Each number is accepted at most once; gaps are counted."""

    low: int = 0  # all numbers below were received or given up
    gaps: int = 0  # numbers that were given up
    _above: set[int] = field(default_factory=set)  # received numbers that are at least `low`

    def __contains__(self, sequence: int) -> bool:
        return sequence < self.low or sequence in self._above

    def add(self, sequence: int) -> None:
        """Mark a sequence number as received."""
        self._above.add(sequence)
        if sequence - self.low >= _REORDERING:
            low = sequence - _REORDERING + 1
            passed = {taken for taken in self._above if taken < low}
            self.gaps += low - self.low - len(passed)
            self._above -= passed
            self.low = low
        while self.low in self._above:
            self._above.remove(self.low)
            self.low += 1

    def give_up(self) -> None:
        """Give up all numbers below the highest received one."""
        end = max(self._above, default=self.low - 1) + 1
        self.gaps += end - self.low - len(self._above)
        self.low = end
        self._above.clear()


_MAX_CONSECUTIVE_UNFIT = 3  # rollouts, after which the incarnation is quarantined
_MAX_FAULTS = 3  # rollouts that were left out of an update, after which the incarnation is quarantined
_GOOD_AGAIN = 100  # rollouts in a row that were learned from, after which the faults before no longer count


@dataclass(frozen=True, slots=True)
class Fault:
    """Why a rollout was left out of an update: the category that it is counted under, and what it has."""

    cause: str
    what: str
    hint: str = ": examine its environment"


NON_FINITE = Fault("non_finite", "no finite gradient", ": its observations or rewards are too large")


# Silence of an actor for so long, or for so many of the longest times between two of its signs of life, is unusual.
_SILENCE_SECONDS, _SILENCE_TIMES = 60.0, 3.0
_REMEMBERED = 0.8  # of the longest time between two signs of life, at each


@dataclass(slots=True)
class Actor:
    """State of one actor; the counts are over all its incarnations."""

    name: str
    epsilon: float = 0.0  # final one, with which it explores
    forgotten_before: int = 0  # a number that is different after an actor of this name was forgotten
    incarnation: int = -1  # the newest; -1 before the first Join
    incarnations: int = 0  # number of incarnations that joined
    origin: Origin = UNKNOWN  # of the newest incarnation
    environments: int = 0  # 0 before the actor has joined with its spaces
    joined: float = 0.0  # when the newest incarnation joined
    last_seen: float = 0.0  # its last sign of life: a rollout or a report, or that it connected
    longest_silence: float = 0.0  # of the last times between two signs of life of this incarnation, in seconds
    left: bool = False  # whether the newest incarnation was present and is no longer
    sequences: SequenceWindow = field(default_factory=SequenceWindow)  # of the newest incarnation
    uploads: int = 0  # rollouts or gradients of the newest incarnation that were received, whatever their verdict
    rows: int = 0  # env_steps that its accepted ones state
    episode_rows: int = 0  # env_steps of the episodes that they report
    matches: int = 0  # that its rollouts report
    accepted: int = 0
    rejected: Counter[str] = field(default_factory=Counter)
    busy: int = 0  # number of `busy` answers
    missed_earlier: int = 0  # rollouts of earlier incarnations that never arrived
    consecutive_unfit: int = 0  # rollouts that violate the specification
    faults: int = 0  # rollouts that were left out of an update
    good_in_a_row: int = 0  # rollouts that were learned from since
    quarantined: str = ""  # the reason, if the newest incarnation is quarantined
    drained_by: str = ""  # who ordered the newest incarnation to leave; empty if nobody did
    env_steps: int = 0
    env_steps_per_second: float = 0.0
    policy_lag: int = 0  # of the newest rollout
    fetches: bool = False  # whether the actor requests its snapshots instead of subscribing
    compact_snapshots: bool = False  # whether it requests compact snapshots
    received_bytes: int = 0  # rollouts, accepted or not
    answered_bytes: int = 0  # requested snapshots
    bytes_up_per_hour: float = 0.0
    bytes_down_per_hour: float = 0.0
    report: ClientReport | None = None  # the newest one of the newest incarnation

    @property
    def incarnation_number(self) -> int:
        """Number that is different for each incarnation of this name."""
        return self.incarnations + (self.forgotten_before << 32)

    @property
    def missed(self) -> int:
        """Number of rollouts that never arrived."""
        return min(self.missed_earlier + self.sequences.gaps, 2**53)

    @property
    def silence_limit(self) -> float:
        """Seconds without a sign of life that are unusual for this actor."""
        return max(_SILENCE_SECONDS, _SILENCE_TIMES * self.longest_silence)

    def heard(self, now: float) -> None:
        """Note a sign of life of the newest incarnation. `now` is on the monotonic clock, in seconds."""
        self.longest_silence = max(now - self.last_seen, _REMEMBERED * self.longest_silence)
        self.last_seen = now

    def count_unfit(self, violation: str) -> None:
        """Count a rollout that violates the specification. Quarantine the actor after three in a row.

        Only consecutive rollouts count: an occasional failure of a simulator does not exclude the actor.
        """
        self.consecutive_unfit += 1
        if self.consecutive_unfit >= _MAX_CONSECUTIVE_UNFIT:
            self.quarantined = bounded_text(f"{self.consecutive_unfit} unfit rollouts in a row, the last: {violation}")

    def count_trained(self, fault: Fault | None = None) -> None:
        """Count a rollout that was trained on, or left out for a fault. Quarantine the actor after several faults.

        Unlike a rejected rollout, such a rollout costs the learner much time. Therefore it takes many good ones to make
        up for it.
        """
        if fault is None:
            self.good_in_a_row += 1
            if self.good_in_a_row >= _GOOD_AGAIN:
                self.faults = 0
            return
        self.rejected[fault.cause] += 1
        self.faults, self.good_in_a_row = self.faults + 1, 0
        if self.faults >= _MAX_FAULTS:
            self.quarantined = bounded_text(f"{self.faults} of its rollouts had {fault.what}{fault.hint}")

    def start_incarnation(self, incarnation: int, next_sequence: int = 0) -> None:
        """Set the newest incarnation, without quarantine; its sequence numbers below `next_sequence` were received."""
        self.sequences.give_up()
        self.missed_earlier = self.missed
        self.incarnation, self.sequences = incarnation, SequenceWindow(low=next_sequence)
        self.incarnations += 1
        self.uploads, self.rows, self.episode_rows, self.matches = next_sequence, 0, 0, 0
        self.consecutive_unfit = self.faults = self.good_in_a_row = 0
        self.left, self.longest_silence = False, 0.0
        self.quarantined = self.drained_by = ""
        self.fetches = self.compact_snapshots = False
        self.report = None
