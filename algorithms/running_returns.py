"""Discounted returns that run on from rollout to rollout of the same environments. State; no I/O, no threads."""

import zlib
from typing import Any, NamedTuple

import numpy as np

from daedalus.protocol.uploads import Rollout, RolloutIdentity

_MAX_STREAMS = 4096  # whose returns are kept, and actors

_Stream = tuple[str, int, int]  # actor, incarnation, checksum of the frames after the last row


class _Newest(NamedTuple):
    """The newest rollout of an actor, and what is known of the actor."""

    identity: RolloutIdentity
    stream: _Stream  # that it belongs to
    several: bool  # the actor has several agents, each with rollouts of its own


class RunningReturns:
    """The return G_t = r_t + discount_factor * G_{t-1} of each row, which begins at 0 with each episode.

    The agents of a client send rollouts of one environment under one name. A rollout continues the one that ends with
    the frames that it begins with. An actor that never showed several agents also continues its previous rollout,
    because a client may have played rows between them that are in no rollout.
    """

    def __init__(self, discount_factor: float) -> None:
        self._discount_factor = discount_factor
        self._running: dict[_Stream, np.ndarray] = {}  # G [E] after the last row
        self._newest: dict[str, _Newest] = {}  # by actor

    def add(self, rollout: Rollout) -> np.ndarray:
        """Return G [T, E] of a rollout. Call once for each rollout, in order."""
        running = self._begin(rollout)
        returns = np.empty((rollout.rows, rollout.environments))
        goes_on = ~(rollout.terminated | rollout.truncated)
        for row in range(rollout.rows):
            running = rollout.rewards[row] + self._discount_factor * running
            returns[row] = running
            running = np.where(goes_on[row], running, 0.0)
        # An actor does not check its rewards: one that is not finite must not reach its later rollouts.
        _set(self._running, self._newest[rollout.identity.actor].stream, np.where(np.isfinite(running), running, 0.0))
        return returns

    def _begin(self, rollout: Rollout) -> np.ndarray:
        """Return G [E] before row 0, 0 if the rollout continues no other, and make the rollout its actor's newest."""
        identity, none = rollout.identity, np.zeros(rollout.environments)
        newest = self._newest.get(identity.actor)
        if newest is not None and newest.identity.incarnation != identity.incarnation:
            newest = None
        several = newest is not None and newest.several
        continued = _stream(rollout, 0)
        if rollout.environments == 1 and continued in self._running:
            several |= newest is not None and continued != newest.stream
            running = self._running.pop(continued)
        elif newest is not None and not several and identity.sequence == newest.identity.sequence + 1:
            running = self._running.get(newest.stream, none)  # stays there: it may be another agent's
        else:
            running = none
        _set(self._newest, identity.actor, _Newest(identity, _stream(rollout, rollout.rows), several))
        return running if len(running) == len(none) else none


def _stream(rollout: Rollout, row: int) -> _Stream:
    """Return the stream of rollouts that has the newest frames of a row; an actor with more environments has one."""
    checksum = 0
    if rollout.environments == 1:
        for frames in rollout.frames.values():
            checksum = zlib.crc32(frames[len(frames) - 1 - rollout.rows + row].tobytes(), checksum)
    return rollout.identity.actor, rollout.identity.incarnation, checksum


def _set(entries: dict[Any, Any], key: object, value: object) -> None:
    """Make an entry the newest, and remove the oldest above the limit."""
    entries.pop(key, None)
    entries[key] = value
    if len(entries) > _MAX_STREAMS:
        del entries[next(iter(entries))]
