"""Events of a run: joins, departures, refusals, rejections, checkpoints, the end. Each is logged and kept for a while.

Peers cause most events. Therefore equal ones are one event with a count, events of actors are rate-limited, and where
the list is full, the oldest event of the owner with the most makes room.
"""

import json
import logging
import threading
import time
from collections import deque
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from daedalus.learner.run.run_directory import EVENTS
from daedalus.policy.saving.regular_files import append_own, read_regular
from daedalus.protocol import keys
from daedalus.protocol.messages import MAX_EVENTS, Event, EventKind
from daedalus.protocol.texts import MAX_NAME, bounded_text, utc, without_secrets

RESTARTED = "restarted"
RESUMED = "resumed: "  # begin of the text of the event "checkpoint" of a run that undoes what came after it
# Begins of the texts of events with an operator's order: of a checkpoint, of a drain, and of the end of the run.
ORDERED_BY, DRAINED_BY, STOPPED_BY = "ordered by ", "drained by ", "stopped by "
_MAX_BYTES = 1 << 20  # later events are left out
_MAX_TEXT = 300  # characters


def dated(text: str) -> str:
    """Return a text with the time before it, by the clock of this host."""
    return f"{utc(time.time())}: {text}"


@dataclass(frozen=True, slots=True, kw_only=True)
class RecordedEvent:
    """One event, or several equal ones. Peers cause events: the texts come from outside."""

    time: str
    kind: str
    actor: str
    text: str
    count: int


class EventFile:
    """Writer of the events of one run. Several processes may write: each write is whole lines."""

    def __init__(self, directory: Path) -> None:
        self._path = directory / EVENTS

    def add(self, events: Sequence[Event]) -> None:
        """Append events. An error leaves them out: the log shows them too."""
        self._append([event.model_dump() for event in events])

    def add_restart(self, text: str) -> None:
        """Append the restart of a process by the launcher."""
        self._append(
            [
                {
                    "time": utc(time.time()),
                    "kind": RESTARTED,
                    "actor": "",
                    "text": without_secrets(text)[:_MAX_TEXT],
                    "count": 1,
                }
            ]
        )

    def _append(self, events: Sequence[dict[str, Any]]) -> None:
        if not events:
            return
        lines = "".join(json.dumps(event) + "\n" for event in events).encode()
        with suppress(OSError), append_own(self._path) as file:
            if file.tell() + len(lines) <= _MAX_BYTES:
                file.write(lines)


def read_events(directory: Path) -> Iterator[RecordedEvent]:
    """Yield the events of a run, oldest first. Damaged lines are left out. Raises OSError except for a missing file.

    Launcher and learner write them, each somewhat after its events.
    """
    try:
        lines = read_regular(directory / EVENTS, 2 * _MAX_BYTES).splitlines()
    except FileNotFoundError:
        return
    events = []
    for line in lines:
        with suppress(ValueError, KeyError, TypeError, OverflowError, RecursionError):
            fields = json.loads(line)
            texts = {name: without_secrets(str(fields[name])[:_MAX_TEXT]) for name in ("time", "kind", "actor", "text")}
            events.append(RecordedEvent(**texts, count=max(int(fields["count"]), 1)))
    yield from sorted(events, key=lambda event: event.time)


_EQUAL_SECONDS = 60.0  # an equal event within this time is counted, not added
_AT_ONCE, _PER_SECOND = 100.0, 1.0  # events of actors

_logger = logging.getLogger(__name__)


@dataclass(slots=True)
class _Entry:
    time: str
    began: float  # on the monotonic clock, in seconds
    key: tuple[EventKind, str, str]  # with the actor and the cause
    text: str
    count: int = 1
    taken: int = 0  # part of the count that take_new has returned


class EventLog:
    """The newest events of one learner process. Any thread may use it."""

    def __init__(self) -> None:
        self._lock = threading.Lock()  # guards all below
        self._entries: deque[_Entry] = deque()  # the newest last
        self._equal: dict[tuple[EventKind, str, str], _Entry] = {}  # the newest of each key
        self._tokens, self._tokens_at = _AT_ONCE, time.monotonic()
        self._omitted = 0  # events of actors, since the last that was added

    def add(self, kind: EventKind, text: str, *, actor: str = "", cause: str = "", level: int = logging.INFO) -> None:
        """Add an event and log it.

        Args:
          kind: what happened.
          text: the description.
          actor: name of the actor that the event is about.
          cause: events of the same kind, actor and cause are equal; by default, those of the same text.
          level: severity of the log record.
        """
        actor, text = bounded_text(actor, MAX_NAME), bounded_text(text)
        key: tuple[EventKind, str, str] = kind, actor, bounded_text(cause) or text
        now = time.monotonic()
        with self._lock:
            equal = self._equal.get(key)
            if equal is not None and now < equal.began + _EQUAL_SECONDS:
                equal.count += 1
                return
            if actor and not self._take_token(now):
                self._omitted += 1
                return
            omitted, self._omitted = self._omitted, 0
            if len(self._entries) >= MAX_EVENTS:
                self._make_room()
            self._equal[key] = _Entry(utc(time.time()), now, key, text)
            self._entries.append(self._equal[key])
        if equal is not None and equal.count > 1:
            text = f"{text} ({equal.count - 1:,} more times since the last message)"
        if omitted:
            _logger.warning("%d events of actors were left out: too many at once", omitted)
        _logger.log(level, "%s", text, extra={"event": kind, "actor": actor})

    def report(self) -> tuple[Event, ...]:
        """Return the newest events, the newest last."""
        with self._lock:
            return tuple(_event(each, each.count) for each in self._entries)

    def take_new(self) -> tuple[Event, ...]:
        """Return the events since the last call, oldest first. A count is that of the time since then."""
        new = []
        with self._lock:
            for each in self._entries:
                if each.count > each.taken:
                    new.append(_event(each, each.count - each.taken))
                    each.taken = each.count
        return tuple(new)

    def _take_token(self, now: float) -> bool:
        self._tokens = min(self._tokens + (now - self._tokens_at) * _PER_SECOND, _AT_ONCE)
        self._tokens_at = now
        if self._tokens < 1.0:
            return False
        self._tokens -= 1.0
        return True

    def _make_room(self) -> None:
        name = keys.first_of_largest_owner(each.key[1] for each in self._entries)
        oldest = next(each for each in self._entries if each.key[1] == name)
        self._entries.remove(oldest)
        if self._equal.get(oldest.key) is oldest:
            del self._equal[oldest.key]


def _event(entry: _Entry, count: int) -> Event:
    kind, actor, _ = entry.key
    return Event(time=entry.time, kind=kind, actor=actor, text=entry.text, count=count)
