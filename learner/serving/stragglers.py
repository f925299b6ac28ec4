"""Which actors a synchronous batch no longer waits for. State; no I/O, no threads."""

from collections import deque
from collections.abc import Set
from dataclasses import dataclass
from statistics import median

_PATIENCE_SECONDS, _PATIENCE_ROLLOUTS = 60.0, 10.0  # the longer of the two; the second in median durations
_LEAST_SECONDS, _LEAST_ROLLOUTS = 1.0, 2.0  # the same for an actor that was left out many times
_SHRINKING = 4.0  # each time that an actor is left out divides the patience with it
_FORGIVEN = 100  # rollouts in time, after which the patience with an actor is whole again
_DURATIONS = 100  # newest durations of which the median is taken
_LONGEST_STEP = 1.0  # seconds between two calls that count as waiting


@dataclass(slots=True)
class _Record:
    """One live actor, as the barrier knows it."""

    awaited_since: float | None = None  # on the waiting clock; None: its rollout is here, or it is left out
    left_out: bool = False
    times: int = 0  # that it was left out, since it was last forgiven
    in_time: int = 0  # rollouts since it was last left out


class Stragglers:
    """Record of the actors that deliver much later than the others, or not at all, although they are connected.

    A simulator that hangs would otherwise hold all updates. An actor that is left out takes part again as soon as it
    sends a rollout, and if it is late again, the next wait is shorter: nobody holds the updates again and again.

    Time counts on a clock of its own, which runs only while the learner waits for a batch: an update, a checkpoint or a
    stopped learner is not the actors' fault.
    """

    def __init__(self) -> None:
        self._records: dict[str, _Record] = {}
        self._durations: deque[float] = deque(maxlen=_DURATIONS)  # of the waits for rollouts, in seconds
        self._clock = 0.0
        self._last: float | None = None  # time of the last call

    @property
    def left_out(self) -> frozenset[str]:
        """Names of the live actors that no batch waits for at present."""
        return frozenset(name for name, record in self._records.items() if record.left_out)

    def awaited(self, live: Set[str], delivered: Set[str], now: float) -> set[str]:
        """Return the actors that the batch still has to wait for, after leaving out those that are overdue.

        Call it again and again while the learner waits.

        Args:
          live: names of the live actors.
          delivered: names of the actors whose rollout for this batch is here.
          now: time on the monotonic clock, in seconds.
        """
        self._clock += 0.0 if self._last is None else min(now - self._last, _LONGEST_STEP)
        self._last = now
        self._records = {name: self._records.get(name) or _Record() for name in live}
        if delivered:  # without any rollout there is nothing to train on, and nobody to compare with
            self._leave_out(live - delivered)
        missing = {name for name in live - delivered if not self._records[name].left_out}
        for name in missing:
            record = self._records[name]
            record.awaited_since = self._clock if record.awaited_since is None else record.awaited_since
        return missing

    def delivered(self, name: str) -> None:
        """Count a rollout that is part of the batch."""
        record = self._records.setdefault(name, _Record())
        if record.awaited_since is not None:
            self._durations.append(self._clock - record.awaited_since)
        record.awaited_since, record.left_out = None, False
        record.in_time += 1
        if record.in_time >= _FORGIVEN:
            record.times = 0

    def heard(self, name: str) -> None:
        """Let an actor take part again: it sent a rollout, which may have come too late for its batch."""
        if name in self._records:
            self._records[name].left_out = False

    def _leave_out(self, missing: Set[str]) -> None:
        for name in missing:
            record = self._records[name]
            if record.awaited_since is not None and self._clock - record.awaited_since > self._patience(record.times):
                record.awaited_since, record.left_out = None, True
                record.times, record.in_time = record.times + 1, 0

    def _patience(self, times: int) -> float:
        """Return how long a batch waits for an actor that was left out `times` times, in seconds."""
        duration = median(self._durations) if self._durations else 0.0
        longest = max(_PATIENCE_SECONDS, _PATIENCE_ROLLOUTS * duration)
        return max(longest / _SHRINKING ** min(times, 32), _LEAST_SECONDS, _LEAST_ROLLOUTS * duration)
