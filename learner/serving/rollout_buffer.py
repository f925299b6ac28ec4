"""Buffers of accepted rollouts or gradients: a barrier for synchronous algorithms, a queue for the others.

No I/O, no threads.
"""

import logging
from collections import deque
from collections.abc import Callable, Set
from dataclasses import dataclass
from statistics import median
from typing import Protocol

from daedalus.protocol.uploads import Upload

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


_logger = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True, kw_only=True)
class TakenRollouts:
    """Rollouts of one batch, and rollouts that became stale in the buffer."""

    rollouts: list[Upload]
    stale: list[Upload]


class RolloutBuffer(Protocol):
    """Interface of a buffer that holds rollouts until a batch is complete."""

    def has_room_for(self, rollout: Upload) -> bool:
        """Return whether `add` may be called with this rollout now."""
        ...

    def add(self, rollout: Upload) -> None:
        """Add a rollout. The caller has checked `has_room_for`."""
        ...

    def heard(self, actor: str) -> None:
        """Record that an actor sent a rollout, which may have come too late for `add`."""
        ...

    def take(self, live: Set[str], policy_version: int, now: float, *, complete: bool = True) -> TakenRollouts:
        """Take the next batch if it is complete, else no rollouts.

        Args:
          live: names of the live actors.
          policy_version: newest policy version; rollouts beyond the policy lag bound are returned as stale.
          now: time on the monotonic clock, in seconds.
          complete: False: take what is there, at the end of a run.
        """
        ...

    @property
    def left_out(self) -> Set[str]:
        """Names of the live actors that no batch waits for, because they deliver nothing."""
        ...


class BarrierBuffer:
    """Buffer of a synchronous algorithm: a batch is one rollout of every live actor, sorted by name.

    The first batch also waits for `first` live actors. A batch does not wait for an actor that has left or that is
    overdue (Stragglers), but contains its rollout of the current version. A batch that fills `most_bytes` is
    complete, too: one peer may join under many names, and send rollouts of zeros, which compress to nothing.
    """

    def __init__(self, first: int, most_bytes: Callable[[], int]) -> None:
        """Construct an empty buffer.

        Args:
          first: number of live actors that the first batch waits for.
          most_bytes: returns the size of the rollouts in memory that no batch exceeds by more than one rollout.
        """
        self._first, self._most_bytes = first, most_bytes
        self._started = False
        self._stragglers = Stragglers()
        self._waiting: dict[str, Upload] = {}
        self._bytes = 0  # of the waiting rollouts

    def has_room_for(self, rollout: Upload) -> bool:
        """Return whether the batch has no rollout of this actor yet, and is not full. See RolloutBuffer."""
        return rollout.identity.actor not in self._waiting and not self._is_full

    def add(self, rollout: Upload) -> None:
        """See RolloutBuffer."""
        self._waiting[rollout.identity.actor] = rollout
        self._bytes += rollout.nbytes
        self._stragglers.delivered(rollout.identity.actor)

    @property
    def _is_full(self) -> bool:
        return bool(self._waiting) and self._bytes >= self._most_bytes()

    def heard(self, actor: str) -> None:
        """See RolloutBuffer."""
        self._stragglers.heard(actor)

    def take(self, live: Set[str], policy_version: int, now: float, *, complete: bool = True) -> TakenRollouts:
        """See RolloutBuffer."""
        awaited = self._stragglers.awaited(live, self._waiting.keys(), now)
        is_first = not self._started and len(live) < self._first
        if not self._waiting or (complete and (is_first or awaited) and not self._is_full):
            return TakenRollouts(rollouts=[], stale=[])
        if complete and (is_first or awaited):
            _logger.warning(
                "a batch has only %d rollouts, because these fill %d MiB of memory",
                len(self._waiting),
                self._bytes >> 20,
            )
        self._started = True
        rollouts = [self._waiting[actor] for actor in sorted(self._waiting)]
        self._waiting.clear()
        self._bytes = 0
        return TakenRollouts(rollouts=rollouts, stale=[])

    @property
    def left_out(self) -> Set[str]:
        """See RolloutBuffer."""
        return self._stragglers.left_out


class StreamBuffer:
    """Buffer of an asynchronous algorithm: a batch is the next `batch_rollouts` rollouts that are not stale.

    The capacity is one batch, and at least two rollouts. This keeps the learner busy; more rollouts would only add
    policy lag.
    """

    def __init__(self, batch_rollouts: int, policy_lag_bound_with: Callable[[int], int]) -> None:
        """Construct an empty buffer.

        Args:
          batch_rollouts: number of rollouts in a batch.
          policy_lag_bound_with: function that returns the largest policy lag, in updates, by the number of live actors.
        """
        self._batch_rollouts = batch_rollouts
        self._policy_lag_bound_with = policy_lag_bound_with
        self._waiting: deque[Upload] = deque()

    def has_room_for(self, rollout: Upload) -> bool:
        """Return whether the buffer is below its capacity. See RolloutBuffer."""
        return len(self._waiting) < max(self._batch_rollouts, 2)

    def add(self, rollout: Upload) -> None:
        """See RolloutBuffer."""
        self._waiting.append(rollout)

    def heard(self, actor: str) -> None:
        """See RolloutBuffer. Has no effect: a batch waits for no particular actor."""

    @property
    def left_out(self) -> Set[str]:
        """See RolloutBuffer. Always empty."""
        return frozenset()

    def take(self, live: Set[str], policy_version: int, now: float, *, complete: bool = True) -> TakenRollouts:
        """See RolloutBuffer."""
        oldest = policy_version - self._policy_lag_bound_with(len(live))
        stale = [rollout for rollout in self._waiting if rollout.policy_version < oldest]
        if stale:
            self._waiting = deque(rollout for rollout in self._waiting if rollout.policy_version >= oldest)
        count = self._batch_rollouts if complete else min(self._batch_rollouts, len(self._waiting))
        if len(self._waiting) < count:
            return TakenRollouts(rollouts=[], stale=stale)
        return TakenRollouts(rollouts=[self._waiting.popleft() for _ in range(count)], stale=stale)
