"""Discounted returns that run on from rollout to rollout of the same environments. State; no I/O, no threads."""

import zlib
from typing import NamedTuple

import numpy as np

from daedalus.protocol.uploads import Rollout

_MAX_STREAMS = 4096  # whose returns are kept


class _Stream(NamedTuple):
    """Which rollout comes next in the same environments."""

    actor: str
    incarnation: int
    next: int  # its sequence number, or a checksum of the frames that it begins with


class RunningReturns:
    """The return G_t = r_t + discount_factor * G_{t-1} of each row, which begins at 0 with each episode.

    A rollout continues the one before it of its actor. But the agents of an asynchronous client send rollouts of one
    environment each, in turns and under one name: these continue the rollout that ended with the frames that they begin
    with. In a synchronous run the agents of a client have common rollouts, and the client plays rows between them.
    """

    def __init__(self, discount_factor: float, *, synchronous: bool = False) -> None:
        self._discount_factor, self._synchronous = discount_factor, synchronous
        self._running: dict[_Stream, np.ndarray] = {}  # G [E] after the last row, by what comes next

    def add(self, rollout: Rollout, largest: float = np.inf) -> np.ndarray:
        """Return G [T, E] of a rollout. Call once for each rollout, in order.

        The next rollout of the stream begins with a G of at most `largest`, positive or negative.
        """
        none = np.zeros(rollout.environments)
        running = self._running.pop(self._stream(rollout, 0), none)
        if len(running) != len(none):
            running = none
        returns = np.empty((rollout.rows, rollout.environments))
        goes_on = ~(rollout.terminated | rollout.truncated)
        for row in range(rollout.rows):
            running = rollout.rewards[row] + self._discount_factor * running
            returns[row] = running
            running = np.where(goes_on[row], running, 0.0)
        # An actor does not check its rewards: one that is not finite must not reach its later rollouts.
        self._running[self._stream(rollout, rollout.rows)] = np.where(np.isfinite(running), running, 0.0).clip(
            -largest, largest
        )
        if len(self._running) > _MAX_STREAMS:
            del self._running[next(iter(self._running))]
        return returns

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
