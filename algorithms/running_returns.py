"""Discounted returns that run on from rollout to rollout of the same environments. State; no I/O, no threads."""

import zlib
from collections import Counter
from typing import Generic, NamedTuple, TypeVar

import numpy as np

from daedalus.protocol.keys import owner
from daedalus.protocol.uploads import Rollout

_MOST_STREAMS = 4096  # with states of size 1
_State = TypeVar("_State")


class _Stream(NamedTuple):
    """Which rollout comes next in the same environments."""

    actor: str
    incarnation: int
    next: int  # its sequence number, or a checksum of the frames that it begins with


class Streams(Generic[_State]):
    """State that goes on from rollout to rollout of the same environments.

    A rollout continues the one before it of its actor. But the agents of an asynchronous client send rollouts of one
    environment each, in turns and under one name: these continue the rollout that ended with the frames that they begin
    with. In a synchronous run the agents of a client have common rollouts, and the client plays rows between them.
    """

    def __init__(self, *, synchronous: bool = False, most: int = _MOST_STREAMS) -> None:
        """Construct it.

        Args:
          synchronous: whether the run makes its actors wait for each update.
          most: sum of the sizes of the states that are kept.
        """
        self._synchronous, self._most = synchronous, most
        self._kept: dict[_Stream, tuple[_State, int]] = {}  # after the last row, with its size, by what comes next
        self._sizes = Counter[str]()  # of all, by owner (protocol/keys.py)
        self.has_forgotten = False

    def take(self, rollout: Rollout) -> _State | None:
        """Return the state before row 0 of a rollout, once; None if its environments are new or were forgotten."""
        return self._pop(self._stream(rollout, 0))

    def put(self, rollout: Rollout, state: _State, size: int = 1) -> None:
        """Keep the state after the last row of a rollout.

        At capacity, the owner of the most forgets what was put first: no owner can then push out the others.
        """
        stream = self._stream(rollout, rollout.rows)
        self._pop(stream)
        self._kept[stream] = state, size
        self._sizes[owner(stream.actor)] += size
        while self._sizes.total() > self._most:
            largest = self._sizes.most_common(1)[0][0]
            self._pop(next(each for each in self._kept if owner(each.actor) == largest))
            self.has_forgotten = True

    def _pop(self, stream: _Stream) -> _State | None:
        state, size = self._kept.pop(stream, (None, 0))
        if size:
            self._sizes[owner(stream.actor)] -= size
            self._sizes += Counter()  # without those of size 0
        return state

    def _stream(self, rollout: Rollout, row: int) -> _Stream:
        """Return the stream of a rollout, before its row 0 or after its last one."""
        identity = rollout.identity
        if rollout.environments > 1 or self._synchronous:
            number = identity.sequence + (row > 0)
        else:
            number = 0
            for frames in rollout.frames.values():
                number = zlib.crc32(frames[len(frames) - 1 - rollout.rows + row].tobytes(), number)
        return _Stream(identity.actor, identity.incarnation, number)


class RunningReturns:
    """The return G_t = r_t + discount_factor * G_{t-1} of each row, which begins at 0 with each episode."""

    def __init__(self, discount_factor: float, *, synchronous: bool) -> None:
        self._discount_factor = discount_factor
        self._streams = Streams[np.ndarray](synchronous=synchronous)  # of G [E]

    def add(self, rollout: Rollout, largest: float = np.inf) -> np.ndarray:
        """Return G [T, E] of a rollout. Call once for each rollout, in order.

        The next rollout of the stream begins with a G of at most `largest`, positive or negative.
        """
        none = np.zeros(rollout.environments)
        running = self._streams.take(rollout)
        if running is None or len(running) != len(none):
            running = none
        returns = np.empty((rollout.rows, rollout.environments))
        goes_on = ~(rollout.terminated | rollout.truncated)
        for row in range(rollout.rows):
            running = rollout.rewards[row] + self._discount_factor * running
            returns[row] = running
            running = np.where(goes_on[row], running, 0.0)
        # An actor does not check its rewards: one that is not finite must not reach its later rollouts.
        kept = np.where(np.isfinite(running), running, 0.0).clip(-largest, largest)
        self._streams.put(rollout, kept)
        return returns
