"""What the page shows: where its data come from, the newest observation, and the viewers that wait for changes."""

import asyncio
import math
from collections.abc import AsyncGenerator, Callable
from dataclasses import dataclass
from typing import Any, Literal, Protocol

from daedalus.gateway.places import Places
from daedalus.gateway.watching.person_matches import Matches
from daedalus.protocol.league import LeagueStatus
from daedalus.protocol.messages import ActorStatus, Event, EventsPage, MetricsReport, Order, RunStatus


class RunSource(Protocol):
    """The learner of one run, as an operator may query it. Calls wait for its answer, at most a few seconds.

    All methods raise TransportError or ProtocolError.
    """

    def status(self, max_actors: int) -> RunStatus | None:
        """Return the status with its first actors, at least `max_actors` if there are so many; None without answer."""
        ...

    def events(self, status: RunStatus) -> EventsPage | None:
        """Return the newest events of a run, or None without an answer."""
        ...

    def metrics(self, status: RunStatus, first: int) -> MetricsReport | None:
        """Return the rows from number `first` on, as many as one answer has; None without an answer."""
        ...

    def order(self, status: RunStatus, order: Order, token: str) -> tuple[bool, str]:
        """Give an order; return whether it is accepted, and what came of it or why it is not.

        `token` says whose token the page sent.
        """
        ...


@dataclass(frozen=True, slots=True, kw_only=True)
class OtherRun:
    """An earlier run that the page compares with."""

    name: str
    rows: list[dict[str, float]]  # by column


@dataclass(frozen=True, slots=True, kw_only=True)
class FolderView:
    """What the run directory has for the page. Texts are printable and without secrets."""

    settings: tuple[tuple[str, str, bool], ...]  # `section.key`, value, and whether it differs from the default
    output: str  # the last lines that actors and evaluations printed
    ends: tuple[str, ...] = ()  # once the learner has ended: result, report and what to do
    stopped: bool = False  # whether it ended before the run was over


ReadFolder = Callable[[str], FolderView | None]  # by the name of the run; None: there is no directory of that run


State = Literal[
    "connecting",  # the network is not reached yet
    "forbidden",  # this gateway may not read the status
    "waiting",  # no learner has answered yet
    "running",
    "lost",  # the learner answered before, and does not now
    "stopped",  # the learner has ended before the run was over
    "ended",
]
_DIGITS = 6
_NOT_FOR_THE_PAGE = {"actors", "league"}  # which have messages of their own


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
    folder: FolderView | None = None


def run_message(seen: Observation) -> dict[str, Any]:
    """Return the message about the run as a whole."""
    status = None if seen.status is None else seen.status.model_dump(mode="json", exclude=_NOT_FOR_THE_PAGE)
    ends = seen.folder.ends if seen.folder and seen.state in ("stopped", "ended") else ()
    return {"type": "run", "state": seen.state, "reason": seen.reason, "ends": ends, "status": status}


def league_message(league: LeagueStatus | None) -> dict[str, Any]:
    """Return the message about the players of a game with opponents; `league` is null for any other run."""
    return {"type": "league", "league": league and league.bounded().model_dump(mode="json")}


def folder_message(folder: FolderView, *, readable: bool) -> dict[str, Any]:
    """Return the message about the run directory, whose parts are None if the viewer may not read it."""
    settings, output = (folder.settings, folder.output) if readable else (None, None)
    return {"type": "folder", "settings": settings, "output": output}


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


MAX_VIEWERS = 32
_OPERATORS = 4  # further pages, for operators
_LAST_SECONDS = 1.0  # to send the last observation

GiveOrder = Callable[[Order, str], tuple[bool, str]]  # waits for the learner, as RunSource.order


class Camera(Protocol):
    """What shows episodes to viewers."""

    def frames(self) -> AsyncGenerator[bytes, None]:
        """Yield frames as soon as there are any, and the newest only, until the caller stops."""
        ...


def _nobody(order: Order, token: str) -> tuple[bool, str]:
    return False, "the learner was not reached yet: try again later"


class PageData:
    """What all viewers see. For the event loop."""

    def __init__(
        self,
        other_runs: Callable[[], list[OtherRun]] = lambda: [],
        camera: Camera | None = None,
        matches: Matches | None = None,
        *,
        takes_clients: bool = True,
    ) -> None:
        """Construct the data.

        Args:
          other_runs: reads the runs to compare with; it may take long.
          camera: shows episodes; None: there is no camera.
          matches: lets persons play against the policy; None: nobody can.
          takes_clients: whether the gateway has clients too; otherwise it serves its page only.
        """
        self.other_runs, self.camera, self.matches, self.takes_clients = other_runs, camera, matches, takes_clients
        self.seen = Observation()
        self.give_order: GiveOrder = _nobody
        self.on_watch: Callable[[bool], None] = lambda watched: None  # receives whether anybody watches
        self.places = Places(MAX_VIEWERS, "pages", reserved=_OPERATORS)
        self.is_closing = False  # the observation is the last
        self._changed = asyncio.Event()
        self._showing: set[asyncio.Task[None]] = set()

    @property
    def is_watched(self) -> bool:
        """Whether anybody watches."""
        return self.places.taken > 0

    def show(self, seen: Observation) -> None:
        """Show an observation to all viewers."""
        self.seen = seen
        self._changed.set()
        self._changed = asyncio.Event()

    def begin(self, showing: asyncio.Task[None]) -> None:
        """Note the task that sends the observations to one viewer. It ends after the last observation."""
        self._showing.add(showing)
        showing.add_done_callback(self._showing.discard)

    async def close(self, last: Observation | None) -> None:
        """Show a last observation to all viewers, and wait until it is sent. At most about 1 s."""
        self.is_closing = True
        self.show(self.seen if last is None else last)
        if self._showing:
            await asyncio.wait(list(self._showing), timeout=_LAST_SECONDS)

    @property
    def news(self) -> asyncio.Event:
        """An event that the next observation sets."""
        return self._changed
