"""What was observed of a run, and its form for the page. Pure functions and immutable values."""

import math
from dataclasses import dataclass
from typing import Any, Literal

from daedalus.protocol.messages import ActorStatus, Event, RunStatus

State = Literal[
    "connecting",  # the network is not reached yet
    "forbidden",  # this gateway may not read the status
    "waiting",  # no learner has answered yet
    "running",
    "lost",  # the learner answered before, and does not now
    "ended",
]
_DIGITS = 6
_NOT_FOR_THE_PAGE = {"actors"}


@dataclass(frozen=True, slots=True, kw_only=True)
class Observation:
    """The newest state of a run. Parts that are equal are the same object as in the observation before."""

    state: State = "connecting"
    reason: str = ""  # of the state, for a person
    status: RunStatus | None = None
    actors: tuple[ActorStatus, ...] = ()
    events: tuple[Event, ...] = ()
    generation: int = 0  # of the rows: another one begins with the first row again
    rows: tuple[tuple[int, dict[str, float]], ...] = ()  # number and values by column


def run_message(seen: Observation) -> dict[str, Any]:
    """Return the message about the run as a whole."""
    status = None if seen.status is None else seen.status.model_dump(mode="json", exclude=_NOT_FOR_THE_PAGE)
    return {"type": "run", "state": seen.state, "reason": seen.reason, "status": status}


def actors_message(actors: tuple[ActorStatus, ...]) -> dict[str, Any]:
    """Return the message with all actors, as a table."""
    columns = list(ActorStatus.model_fields)
    rows = [[_short(value) for value in actor.model_dump(mode="json").values()] for actor in actors]
    return {"type": "actors", "columns": columns, "rows": rows}


def events_message(events: tuple[Event, ...]) -> dict[str, Any]:
    """Return the message with the newest events."""
    return {"type": "events", "events": [event.model_dump(mode="json") for event in events]}


def table(rows: list[dict[str, float]]) -> dict[str, Any]:
    """Return rows of metrics as a table; null where a row has no value."""
    columns = list(dict.fromkeys(name for row in rows for name in row))
    return {"columns": columns, "rows": [[_short(row.get(name)) for name in columns] for row in rows]}


def metrics_message(seen: Observation, begun: bool, first: int) -> dict[str, Any]:
    """Return the message with the rows from number `first` on.

    `begun`: whether the viewer has rows of this generation; otherwise these replace what it has.
    """
    rows = [row for number, row in seen.rows if number >= first]
    return {"type": "metrics", "reset": not begun, **table(rows)}


def _short(value: Any) -> Any:
    """Return a number with few digits; None if it is not finite. Other values stay."""
    if not isinstance(value, float):
        return value
    return float(f"{value:.{_DIGITS}g}") if math.isfinite(value) else None
