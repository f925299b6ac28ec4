"""The actors that were refused or have failed before they joined, for the status of the run. No I/O."""

from dataclasses import dataclass

from daedalus.protocol import keys
from daedalus.protocol.messages import Origin, RefusedJoin
from daedalus.protocol.texts import MAX_NAME, bounded_text

_MAX_ENTRIES = 32
_FORGET_REFUSAL_SECONDS = 3600.0  # after the last refusal


@dataclass(slots=True)
class _Entry:
    actor: str
    origin: Origin
    reason: str
    count: int = 0
    last_at: float = 0.0


class RefusedJoins:
    """Bounded table of refusals: one entry for each host and reason, so that restarts of an actor add no entries."""

    def __init__(self) -> None:
        self._entries: dict[tuple[str, str], _Entry] = {}  # by host (or actor) and reason, the newest last

    def add(self, actor: str, origin: Origin, reason: str, now: float) -> None:
        """Count a refusal.

        Args:
          actor: name of the actor.
          origin: where the actor runs; empty texts if that is not known.
          reason: why it was refused, or why it failed.
          now: time on the monotonic clock, in seconds.
        """
        self._forget_old(now)
        actor, origin, reason = bounded_text(actor, MAX_NAME), bounded(origin), bounded_text(reason)
        key = (origin.host or actor, reason)
        entry = self._entries.pop(key, None)
        if entry is None:
            self._make_room()
            entry = _Entry(actor, origin, reason)
        entry.actor, entry.origin = actor, origin
        entry.count, entry.last_at = entry.count + 1, now
        self._entries[key] = entry

    def joined(self, actor: str) -> None:
        """Remove the entries of an actor that has joined since."""
        for key in [key for key, entry in self._entries.items() if entry.actor == actor]:
            del self._entries[key]

    def report(self, now: float) -> tuple[RefusedJoin, ...]:
        """Return the entries, the newest last. `now` is on the monotonic clock, in seconds."""
        self._forget_old(now)
        return tuple(
            RefusedJoin(
                actor=entry.actor,
                host=entry.origin.host,
                software=entry.origin.software,
                reason=entry.reason,
                count=entry.count,
                seconds_since_last=max(now - entry.last_at, 0.0),
            )
            for entry in self._entries.values()
        )

    def _forget_old(self, now: float) -> None:
        for key in [key for key, entry in self._entries.items() if now - entry.last_at > _FORGET_REFUSAL_SECONDS]:
            del self._entries[key]

    def _make_room(self) -> None:
        """Remove the oldest entry of the owner that has the most: no owner can push out the others."""
        if len(self._entries) >= _MAX_ENTRIES:
            name = keys.first_of_largest_owner(entry.actor for entry in self._entries.values())
            del self._entries[next(key for key, entry in self._entries.items() if entry.actor == name)]


def bounded(origin: Origin) -> Origin:
    """Return an origin whose texts are bounded."""
    return Origin(
        host=bounded_text(origin.host, MAX_NAME),
        software=bounded_text(origin.software, MAX_NAME),
        address=bounded_text(origin.address, MAX_NAME),
    )
