"""One page that watches: its WebSocket. An ASGI application for one connection."""

import asyncio
import contextlib
import json
import logging
import time
from collections.abc import AsyncGenerator
from typing import Any, Literal, NamedTuple

from daedalus.gateway.channel import HELLO_SECONDS
from daedalus.gateway.client_messages import ClientError
from daedalus.gateway.conversation_end import Connection
from daedalus.gateway.security import OPERATOR, Guard, RateLimit
from daedalus.gateway.watching import page_data
from daedalus.gateway.watching.page_data import Observation, PageData
from daedalus.gateway.watching.person_matches import BeginMatch, MatchOrder, PlayMove, new_orders
from daedalus.protocol.league import LeagueStatus
from daedalus.protocol.messages import Order

MAX_BYTES = 4096


class ViewerHello(NamedTuple):
    """The first message of a page."""

    token: str


class ViewerOrder(NamedTuple):
    """An order to the learner."""

    order: Order
    token: str  # of an operator


class ViewerCamera(NamedTuple):
    """Whether the page shows the camera."""

    on: bool


ViewerMessage = ViewerHello | ViewerOrder | ViewerCamera | MatchOrder
_FIELDS: dict[str, set[str]] = {
    "hello": {"type", "token"},
    "order": {"type", "order", "token"},
    "camera": {"type", "on"},
    "match": {"type", "agent", "sampled"},
    "move": {"type", "turn", "action"},
}
_MOST_NUMBERS = 1024  # of a move
_LARGEST = 1e9


def read_message(data: str | bytes | None) -> ViewerMessage:
    """Return a message of a page. Raises ClientError if it is malformed."""
    message = _decoded(data)
    kind = message.get("type")
    if not isinstance(kind, str) or message.keys() != _FIELDS.get(kind):
        raise ClientError("malformed", "the message is none that a page sends")
    match message:
        case {"type": "hello", "token": str(token)}:
            return ViewerHello(token)
        case {"type": "order", "order": "stop" | "checkpoint" as order, "token": str(token)}:
            chosen: Literal["stop", "checkpoint"] = order
            return ViewerOrder(chosen, token)
        case {"type": "camera", "on": bool(on)}:
            return ViewerCamera(on)
        case {"type": "match", "agent": str(agent), "sampled": bool(sampled)}:
            return BeginMatch(agent, sampled)
        case {"type": "move", "turn": int(turn), "action": dict(action)} if _are_numbers(action):
            return PlayMove(turn, action)
        case _:
            raise ClientError("malformed", f"{kind} has a field of a wrong type")


def _are_numbers(action: dict[str, Any]) -> bool:
    """Return whether an action has a list of finite numbers by component."""
    lists = list(action.values())
    return all(isinstance(each, list) and len(each) <= _MOST_NUMBERS for each in lists) and all(
        type(value) in (int, float) and abs(value) <= _LARGEST for each in lists for value in each
    )


def _decoded(data: str | bytes | None) -> dict[str, Any]:
    if not isinstance(data, str) or len(data) > MAX_BYTES:
        raise ClientError("malformed", f"a message must be JSON of at most {MAX_BYTES} bytes")
    try:
        message = json.loads(data)
    except (ValueError, RecursionError):
        raise ClientError("malformed", "the message is not JSON") from None
    if not isinstance(message, dict):
        raise ClientError("malformed", "the message is not a map")
    return message


_logger = logging.getLogger(__name__)

_MAX_FAULTS = 5  # of one page; then it is disconnected
_RATE, _BURST = 2.0, 20.0  # messages of one page a second


class ViewerConnection(Connection):
    """The conversation with one page. It receives what has changed, and no more than it can take."""

    def __init__(self, data: PageData, guard: Guard, scope: Any, receive: Any, send: Any) -> None:
        super().__init__(scope, send)
        self._data, self._guard, self._receive = data, guard, receive
        self._rate = RateLimit(_RATE, _BURST)
        self._sent: Observation | None = None
        self._camera: asyncio.Task[None] | None = None
        self._match: asyncio.Task[None] | None = None
        self._orders = new_orders()  # for the match
        self._owner = ""  # of the page's places
        self._telling: asyncio.Task[None] | None = None  # why a match ended
        self._reads_folder = False

    async def serve(self) -> None:
        """Serve the page until it is closed."""
        await self._until_end(self._take_part())

    async def _take_part(self) -> None:
        await self._receive()  # the request to connect
        self._channel.limit(MAX_BYTES)
        await self._send_event({"type": "websocket.accept"})
        with contextlib.suppress(OSError, EOFError):  # the page is closed
            owner = await self._greet()
            is_operator = owner.startswith(OPERATOR)
            self._reads_folder = bool(owner)  # without a token: whoever reaches the gateway; a run directory is private
            try:
                self._owner = owner or self._channel.peer
                with self._data.places.take(self._owner, self.end, is_operator=is_operator):
                    self._channel.settle(True)
                    self._data.on_watch(True)
                    await self._converse()
            finally:
                self._data.on_watch(self._data.is_watched)

    async def _greet(self) -> str:
        """Return the owner of the page's token."""
        try:
            async with asyncio.timeout(HELLO_SECONDS):
                message = await self._next()
        except TimeoutError:
            raise ClientError("malformed", f"no hello came within {HELLO_SECONDS:g} s") from None
        if not isinstance(message, ViewerHello):
            raise ClientError("out_of_turn", "the first message must be a hello")
        return self._guard.check_viewer(message.token)

    async def _converse(self) -> None:
        data = self._data
        offers = {"orders": self._guard.takes_orders, "clients": data.takes_clients}
        offers |= {"camera": data.camera is not None, "matches": data.matches is not None}
        await self._send({"type": "hello", **offers})
        showing = asyncio.create_task(self._show())
        data.begin(showing)
        try:
            await self._obey()
        finally:
            for task in (showing, self._camera, self._match):
                if task is not None:
                    task.cancel()

    # ------------------------------------------------------------------------------------------- to the page

    async def _show(self) -> None:
        """Send what has changed, again and again."""
        with contextlib.suppress(OSError):  # the page is closed
            others = await asyncio.to_thread(self._data.other_runs)
            await self._send_texts(
                [{"type": "comparison", "name": run.name, **page_data.table(run.rows)} for run in others]
            )
            while True:
                news = self._data.news
                seen = self._data.seen
                await self._send_texts(await asyncio.to_thread(self._changes, seen))
                self._sent = seen
                if self._data.is_closing and seen is self._data.seen:
                    return
                await news.wait()

    def _changes(self, seen: Observation) -> list[dict[str, Any]]:
        """Return the messages about what differs from what was sent; all at first, in place of what the page had."""
        sent, messages = self._sent, [page_data.run_message(seen)]
        if sent is None or _league(seen) != _league(sent):
            messages.append(page_data.league_message(_league(seen)))
        if sent is None or seen.actors is not sent.actors:
            messages.append(page_data.actors_message(seen.actors))
        if sent is None or seen.events is not sent.events:
            messages.append(page_data.events_message(seen.events))
        if seen.folder is not None and (sent is None or seen.folder != sent.folder):
            messages.append(page_data.folder_message(seen.folder, readable=self._reads_folder))
        if sent is None or sent.generation != seen.generation:
            messages.append(page_data.metrics_message(seen, False, 0))
        elif seen.rows is not sent.rows:
            first = sent.rows[-1][0] + 1 if sent.rows else 0
            messages.append(page_data.metrics_message(seen, True, first))
        return messages

    async def _send_texts(self, messages: list[dict[str, Any]]) -> None:
        for message in messages:
            await self._send(message)

    async def _send(self, message: dict[str, Any]) -> None:
        text = await asyncio.to_thread(json.dumps, message, separators=(",", ":"), allow_nan=False)
        await self._send_event({"type": "websocket.send", "text": text})

    async def _send_frames(self, source: AsyncGenerator[bytes, None]) -> None:
        with contextlib.suppress(OSError):  # the page is closed
            async with contextlib.aclosing(source) as frames:
                async for frame in frames:
                    await self._send_event({"type": "websocket.send", "bytes": frame})

    def _begin_match(self) -> None:
        """Take a place among those who play. Raises ClientError if there is none."""
        matches = self._data.matches
        if matches is None:
            raise ClientError("refused", "this gateway plays no matches: it was started with --no-camera")
        place = contextlib.ExitStack()
        place.enter_context(matches.places.take(self._owner, self._end_match))
        self._orders = new_orders()
        self._match = asyncio.create_task(self._send_frames(matches.play(self._orders)))
        self._match.add_done_callback(lambda _: place.close())

    def _end_match(self, reason: ClientError) -> None:
        """End the match: another person needs its place."""
        if self._match is not None and self._match.cancel():
            self._telling = asyncio.create_task(self._tell(reason))

    async def _tell(self, reason: ClientError) -> None:
        with contextlib.suppress(OSError):  # the page is closed
            await self._send({"type": "refused", "reason": reason.reason})

    # ----------------------------------------------------------------------------------------- from the page

    async def _next(self) -> ViewerMessage:
        """Return the next message. Raises EOFError if the page is closed, ClientError if the message is malformed."""
        event = await self._receive()
        if event["type"] == "websocket.disconnect":
            raise EOFError
        return read_message(event.get("text"))

    async def _obey(self) -> None:
        faults = 0
        while True:
            try:
                message = await self._next()
                if pause := self._rate.take(time.monotonic()):
                    await asyncio.sleep(pause)
                await self._answer(message)
            except ClientError as error:
                faults += 1
                if faults == _MAX_FAULTS:
                    raise
                await self._send({"type": "refused", "reason": error.reason})

    async def _answer(self, message: ViewerMessage) -> None:
        match message:
            case ViewerOrder():
                owner = self._guard.check_operator(message.token)
                _logger.info("a page with the token of %s orders: %s", owner, message.order)
                accepted, result = await asyncio.to_thread(self._data.give_order, message.order, owner)
                if not accepted:
                    raise ClientError("unavailable", result)
                await self._send({"type": "ordered", "order": message.order, "result": result})
            case ViewerCamera(on=on):
                if self._camera is not None:
                    self._camera.cancel()
                self._camera = None
                if on and self._data.camera is not None:
                    self._camera = asyncio.create_task(self._send_frames(self._data.camera.frames()))
            case BeginMatch() | PlayMove():
                if self._match is None or self._match.done():
                    if isinstance(message, PlayMove):
                        raise ClientError("out_of_turn", "there is no match: begin one")
                    self._begin_match()
                if self._orders.full():
                    raise ClientError("unavailable", "the moves before this one are not played yet: wait for them")
                self._orders.put_nowait(message)
            case ViewerHello():
                raise ClientError("out_of_turn", "a connection has one hello")


def _league(seen: Observation) -> LeagueStatus | None:
    return seen.status and seen.status.league
