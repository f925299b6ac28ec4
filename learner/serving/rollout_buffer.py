"""Accepted rollouts -> the rollouts of one batch. The synchronous barrier lives here. No I/O, no threads."""

from collections import deque
from collections.abc import Set
from dataclasses import dataclass
from typing import Protocol

from daedalus.protocol.messages import Rollout


@dataclass(frozen=True, slots=True, kw_only=True)
class TakenRollouts:
    """One batch's rollouts, and those that grew too old while they waited."""

    rollouts: list[Rollout]
    stale: list[Rollout]


class RolloutBuffer(Protocol):
    """Holds rollouts until a batch is complete."""

    def has_room_for(self, rollout: Rollout) -> bool:
        """Whether `add` may be called; if not, whether it may later is the buffer's own law."""
        ...

    def add(self, rollout: Rollout) -> None:
        """Takes in a rollout."""
        ...

    def take(self, live: Set[str], policy_version: int) -> TakenRollouts:
        """The next batch if it is complete, else no rollouts. `live` are the actors that take part."""
        ...


class BarrierBuffer:
    """Synchronous: a batch is one rollout of every live actor, in the order of their names.

    The first batch also waits until `first` actors are there. An actor that leaves is no longer waited for;
    what it had sent under the current version counts.
    """

    def __init__(self, first: int) -> None:
        self._first = first
        self._started = False
        self._waiting: dict[str, Rollout] = {}

    def has_room_for(self, rollout: Rollout) -> bool:
        """See RolloutBuffer: an actor has one rollout a batch."""
        return rollout.identity.actor not in self._waiting

    def add(self, rollout: Rollout) -> None:
        """See RolloutBuffer."""
        self._waiting[rollout.identity.actor] = rollout

    def take(self, live: Set[str], policy_version: int) -> TakenRollouts:
        """See RolloutBuffer."""
        if not self._started and len(live) < self._first:
            return TakenRollouts(rollouts=[], stale=[])
        if not self._waiting or live - self._waiting.keys():
            return TakenRollouts(rollouts=[], stale=[])
        self._started = True
        rollouts = [self._waiting[actor] for actor in sorted(self._waiting)]
        self._waiting.clear()
        return TakenRollouts(rollouts=rollouts, stale=[])


class StreamBuffer:
    """Asynchronous: a batch is the next `batch_rollouts` rollouts that are not too old, whoever sent them.

    Holds the batch that the learner takes next, and two rollouts at least: enough to keep it busy, and every one more
    would only add policy lag.
    """

    def __init__(self, batch_rollouts: int, max_policy_lag: int) -> None:
        self._batch_rollouts = batch_rollouts
        self._max_policy_lag = max_policy_lag
        self._waiting: deque[Rollout] = deque()

    def has_room_for(self, rollout: Rollout) -> bool:
        """See RolloutBuffer: there is room again once a batch was taken."""
        return len(self._waiting) < max(self._batch_rollouts, 2)

    def add(self, rollout: Rollout) -> None:
        """See RolloutBuffer."""
        self._waiting.append(rollout)

    def take(self, live: Set[str], policy_version: int) -> TakenRollouts:
        """See RolloutBuffer."""
        oldest = policy_version - self._max_policy_lag
        stale = [rollout for rollout in self._waiting if rollout.policy_version < oldest]
        if stale:
            self._waiting = deque(rollout for rollout in self._waiting if rollout.policy_version >= oldest)
        if len(self._waiting) < self._batch_rollouts:
            return TakenRollouts(rollouts=[], stale=stale)
        return TakenRollouts(rollouts=[self._waiting.popleft() for _ in range(self._batch_rollouts)], stale=stale)
