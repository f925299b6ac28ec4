"""The file events.jsonl of a run directory: what happened in a run, from all its learner processes and the launcher.

One JSON object a line, with the fields of protocol/messages.py's Event. The kind "restarted" is that of the launcher.
"""

import json
import time
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from daedalus.learner.run.run_directory import EVENTS
from daedalus.policy.saving.regular_files import append_own, read_regular
from daedalus.protocol.messages import Event
from daedalus.protocol.texts import utc, without_secrets

RESTARTED = "restarted"
RESUMED = "resumed: "  # begin of the text of the event "checkpoint" of a run that undoes what came after it
_MAX_BYTES = 1 << 20  # later events are left out
_MAX_TEXT = 300  # characters


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
