"""One client's WebSocket: reads its messages in turn, and answers them. An ASGI application for one connection."""

import asyncio
import contextlib
import logging
import time
from collections import deque
from functools import partial
from typing import Any

from daedalus.gateway import client_messages
from daedalus.gateway.channel import HELLO_SECONDS
from daedalus.gateway.client_actor import ClientActor
from daedalus.gateway.client_gateway import JOIN_SECONDS, Gateway
from daedalus.gateway.client_messages import (
    TRANSITIONS,
    Act,
    AskParameters,
    ClientError,
    EndEpisode,
    Hello,
    Reward,
    State,
)
from daedalus.gateway.conversation_end import Connection
from daedalus.gateway.places import Places
from daedalus.gateway.security import MESSAGES_BURST, MESSAGES_PER_SECOND, Guard, RateLimit

_logger = logging.getLogger(__name__)

_MAX_UNANSWERED = 8  # messages of one client; then reading pauses
_MAX_EARLY = 2  # messages of one client that are read before it is admitted
_MAX_FAULTS = 10  # of one client; then it is disconnected


class ClientConnection(Connection):
    """The conversation with one client.

    The hello is read as ASGI has it. After it each message is answered as it arrives, without a switch of tasks: that
    would take as long as the answer.
    """

    def __init__(
        self, gateway: "asyncio.Future[Gateway]", guard: Guard, places: Places, scope: Any, receive: Any, send: Any
    ) -> None:
        """`gateway` has its result when the network is reached."""
        super().__init__(scope, send)
        self._reached, self._guard, self._places, self._scope = gateway, guard, places, scope
        self._receive_event = receive
        self._states: dict[str, State] = {"": "new"}  # of the seats of the client's match; without one of the client
        self._as_text = True
        self._gateway: Gateway | None = None  # while messages are answered
        self._actors: dict[str, ClientActor] = {}  # by seat
        self._unanswered: deque[str | bytes] = deque()
        self._held: AskParameters | Act | Reward | EndEpisode | None = None  # read, of a seat that waits for its action
        self._waiting = set[str]()  # seats that wait for their actions
        self._is_paused = False  # by the rate limit
        self._rate = RateLimit()
        self._faults = 0

    async def serve(self) -> None:
        """Serve the client until it disconnects, the run ends, or it breaks the rules too often."""
        await self._until_end(self._converse())

    async def _converse(self) -> None:
        await self._receive_event()  # the request to connect
        await self._send_event({"type": "websocket.accept"})
        try:
            async with asyncio.timeout(HELLO_SECONDS):
                event = await self._receive_event()
        except TimeoutError:
            raise ClientError("malformed", f"no hello came within {HELLO_SECONDS:g} s") from None
        if event["type"] == "websocket.disconnect":
            return
        text = event.get("text")
        self._as_text = text is not None
        hello = client_messages.read(event["bytes"] if text is None else text, self._states)
        assert isinstance(hello, Hello)
        owner = self._guard.check_token(hello.name, hello.token) or self._channel.peer
        seats = max(len(hello.match), 1)
        with contextlib.ExitStack() as places:
            for _ in range(seats):
                places.enter_context(self._places.take(owner, self.end))
            self._rate = RateLimit(seats * MESSAGES_PER_SECOND, seats * MESSAGES_BURST)
            self._channel.settle(True)
            await self._take_part(hello)

    async def _take_part(self, hello: Hello) -> None:
        address = self._address()
        reading = asyncio.create_task(self._read_early())
        try:
            gateway = await self._reach()
            actors = await gateway.admit(hello, address, self.end)
        finally:
            reading.cancel()
        try:
            first = next(iter(actors.values()))
            self._channel.limit(first.spaces.max_message_bytes)
            session = gateway.run.session
            if session is not None:
                self._write(client_messages.welcome(session.run, session.spec.environment.id, hello.name))
            _logger.info("client %s connected from %s", hello.name, address)
            self._states = dict.fromkeys(actors, "ready")
            self._gateway, self._actors = gateway, actors
            self._channel.divert(self._on_message, self._go_on)
            self._go_on()  # with messages that came early
            while (await self._receive_event())["type"] != "websocket.disconnect":
                pass
        finally:
            self._gateway = None
            gateway.leave(actors)
            _logger.info("client %s disconnected", hello.name)

    async def _read_early(self) -> None:
        """Keep messages that come before the answer to hello; end the connection if the client disconnects.

        The server keeps those beyond `_MAX_EARLY`: it bounds their memory, but does not notice the end behind them.
        """
        while len(self._unanswered) < _MAX_EARLY:
            event = await self._receive_event()
            if event["type"] == "websocket.disconnect":
                self.end(ClientError("unavailable", "the client disconnected"))
                return
            text = event.get("text")
            self._unanswered.append(event["bytes"] if text is None else text)

    async def _reach(self) -> Gateway:
        try:
            async with asyncio.timeout(JOIN_SECONDS):
                return await asyncio.shield(self._reached)
        except TimeoutError:
            raise ClientError("unavailable", f"no learner came within {JOIN_SECONDS:g} s: try again later") from None

    def _address(self) -> str:
        host, port = self._scope.get("client") or ("", 0)
        return f"ws/{host}:{port}"

    # ---------------------------------------------------------------------------------- called by the channel

    def _on_message(self, data: str | bytes) -> None:
        self._unanswered.append(data)
        self._go_on()

    def _go_on(self) -> None:
        """Answer messages in turn, until an action must be chosen, the client is too fast, or it does not read.

        A seat that waits for its action holds up messages of its own, and those behind them.
        """
        while self._may_answer():
            if self._held is not None:
                held, self._held = self._held, None
                self._answer(held)
            elif pause := self._rate.take(time.monotonic()):
                self._is_paused = True
                asyncio.get_running_loop().call_later(pause, self._after_pause)
            else:
                self._read(self._unanswered.popleft())
        self._channel.pause(len(self._unanswered) >= _MAX_UNANSWERED)

    def _may_answer(self) -> bool:
        if self._gateway is None or self._is_paused or not self._channel.is_writable or self._end is not None:
            return False
        if self._held is not None:
            return self._held.seat not in self._waiting
        return bool(self._unanswered) and len(self._waiting) < len(self._states)

    def _after_pause(self) -> None:
        self._is_paused = False
        if self._gateway is not None:
            self._read(self._unanswered.popleft())
            self._go_on()

    def _read(self, data: str | bytes) -> None:
        try:
            message = client_messages.read(data, self._states)
        except ClientError as error:
            self._refuse(error, "")
            return
        assert not isinstance(message, Hello)  # which is out of turn
        if message.seat in self._waiting:
            self._held = message
        else:
            self._answer(message)

    def _answer(self, message: AskParameters | Act | Reward | EndEpisode) -> None:
        assert self._gateway is not None
        seat = message.seat
        actor = self._actors[seat]
        actor.heard_at = time.monotonic()
        try:
            match message:
                case AskParameters():
                    self._write(client_messages.parameters(self._gateway.parameters(actor), seat))
                case Act():
                    self._gateway.act(actor, message, partial(self._on_action, seat))
                    self._waiting.add(seat)
                    self._states[seat] = TRANSITIONS[self._states[seat], "act"]
                case Reward():
                    actor.reward(message.reward)
                    self._channel.acknowledge()
                case EndEpisode():
                    actor.end_episode(message)
                    self._states[seat] = TRANSITIONS[self._states[seat], "end_episode"]
                    self._channel.acknowledge()
        except ClientError as error:
            self._refuse(error, seat)

    def _refuse(self, error: ClientError, seat: str) -> None:
        self._faults += 1
        if self._faults == _MAX_FAULTS:
            self.end(error)
        else:
            self._write(client_messages.error(error, seat))

    def _on_action(self, seat: str, action: Any) -> None:
        self._waiting.discard(seat)
        self._write(client_messages.action(action, seat))
        if self._unanswered or self._held is not None:
            self._go_on()

    async def _send(self, message: dict[str, Any]) -> None:
        self._write(message)

    def _write(self, message: dict[str, Any]) -> None:
        self._channel.write(client_messages.encode(message, as_text=self._as_text))
