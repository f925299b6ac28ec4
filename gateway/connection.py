"""One client's WebSocket: reads its messages in turn, and answers them. An ASGI application for one connection."""

import asyncio
import contextlib
import logging
import time
from collections import deque
from typing import Any

from daedalus.gateway import client_messages
from daedalus.gateway.channel import channel_of
from daedalus.gateway.client_actor import ClientActor
from daedalus.gateway.client_gateway import JOIN_SECONDS, Gateway
from daedalus.gateway.client_messages import TRANSITIONS, Act, ClientError, EndEpisode, Hello, Reward, State
from daedalus.gateway.places import Places
from daedalus.gateway.security import Guard, RateLimit

_logger = logging.getLogger(__name__)

HELLO_SECONDS = 10.0  # from the connection to the hello
_SEND_SECONDS = 5.0  # for the last message
_MAX_UNANSWERED = 8  # messages of one client; then reading pauses
_MAX_EARLY = 2  # messages of one client that are read before it is admitted
_MAX_FAULTS = 10  # of one client; then it is disconnected
_OK, _FAULT, _TRY_LATER = 1000, 1008, 1013  # codes of RFC 6455


class ClientConnection:
    """The conversation with one client.

    The hello is read as ASGI has it. After it each message is answered as it arrives, without a switch of tasks: that
    would take as long as the answer.
    """

    def __init__(
        self, gateway: "asyncio.Future[Gateway]", guard: Guard, places: Places, scope: Any, receive: Any, send: Any
    ) -> None:
        """`gateway` has its result when the network is reached."""
        self._reached, self._guard, self._places, self._scope = gateway, guard, places, scope
        self._receive_event, self._send_event = receive, send
        self._channel = channel_of(scope)
        self._state: State = "new"
        self._as_text = True
        self._end: ClientError | str | None = None  # why the gateway ends the connection
        self._task: asyncio.Task[Any] | None = None
        self._seat: tuple[Gateway, ClientActor] | None = None  # while messages are answered
        self._unanswered: deque[str | bytes] = deque()
        self._is_waiting = False  # for an action, or for the rate limit
        self._rate = RateLimit()
        self._faults = 0

    async def serve(self) -> None:
        """Serve the client until it disconnects, the run ends, or it breaks the rules too often."""
        self._task = asyncio.current_task()
        await self._receive_event()  # the request to connect
        await self._send_event({"type": "websocket.accept"})
        try:
            await self._converse()
        except asyncio.CancelledError:
            if self._end is None or self._task is None:
                raise
            self._task.uncancel()
            await self._finish(self._end)
        except ClientError as error:
            await self._finish(error)

    def end(self, reason: ClientError | str) -> None:
        """End the connection, with an error or with how the run ended. Idempotent. See Gateway.admit."""
        if self._end is None and self._task is not None:
            self._end = reason
            self._task.cancel()

    async def _converse(self) -> None:
        try:
            async with asyncio.timeout(HELLO_SECONDS):
                event = await self._receive_event()
        except TimeoutError:
            raise ClientError("malformed", f"no hello came within {HELLO_SECONDS:g} s") from None
        if event["type"] == "websocket.disconnect":
            return
        text = event.get("text")
        self._as_text = text is not None
        hello = client_messages.read(event["bytes"] if text is None else text, self._state)
        assert isinstance(hello, Hello)
        owner = self._guard.check_token(hello.name, hello.token) or self._channel.peer
        with self._places.take(owner, self.end):
            self._channel.settle(True)
            await self._take_part(hello)

    async def _take_part(self, hello: Hello) -> None:
        address = self._address()
        reading = asyncio.create_task(self._read_early())
        try:
            gateway = await self._reach()
            actor = await gateway.admit(hello, address, self.end)
        finally:
            reading.cancel()
        try:
            self._channel.limit(actor.spaces.max_message_bytes)
            session = gateway.run.session
            if session is not None:
                self._write(client_messages.welcome(session.run, session.spec.environment.id, hello.name))
            _logger.info("client %s connected from %s", actor.name, address)
            self._state, self._seat = "ready", (gateway, actor)
            self._channel.divert(self._on_message, self._go_on)
            self._go_on()  # with messages that came early
            while (await self._receive_event())["type"] != "websocket.disconnect":
                pass
        finally:
            self._seat = None
            gateway.leave(actor)
            _logger.info("client %s disconnected", actor.name)

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
        """Answer messages in turn, until an action must be chosen, the client is too fast, or it does not read."""
        while self._unanswered and not self._is_waiting and self._channel.is_writable and self._end is None:
            if self._seat is None:
                return
            now = self._seat[1].heard_at = time.monotonic()
            if pause := self._rate.take(now):
                self._is_waiting = True
                asyncio.get_running_loop().call_later(pause, self._after_pause)
            else:
                self._answer(*self._seat, self._unanswered.popleft())
        self._channel.pause(len(self._unanswered) >= _MAX_UNANSWERED)

    def _after_pause(self) -> None:
        self._is_waiting = False
        if self._seat is not None:
            self._answer(*self._seat, self._unanswered.popleft())
            self._go_on()

    def _answer(self, gateway: Gateway, actor: ClientActor, data: str | bytes) -> None:
        try:
            match message := client_messages.read(data, self._state):
                case Act():
                    gateway.act(actor, message, self._on_action)
                    self._is_waiting = True
                case Reward():
                    actor.reward(message.reward)
                    self._channel.acknowledge()
                case EndEpisode():
                    actor.end_episode(message)
                    self._state = TRANSITIONS[self._state, "end_episode"]
                    self._channel.acknowledge()
        except ClientError as error:
            self._faults += 1
            if self._faults == _MAX_FAULTS:
                self.end(error)
            else:
                self._write(client_messages.error(error))

    def _on_action(self, action: Any) -> None:
        self._is_waiting, self._state = False, TRANSITIONS[self._state, "act"]
        self._write(client_messages.action(action))
        if self._unanswered:
            self._go_on()

    def _write(self, message: dict[str, Any]) -> None:
        self._channel.write(client_messages.encode(message, as_text=self._as_text))

    async def _finish(self, reason: ClientError | str) -> None:
        """Say why the connection ends, and close it."""
        self._channel.settle(False)
        if isinstance(reason, str):
            message, code = client_messages.run_ended(reason), _OK
        else:
            message, code = client_messages.error(reason), _TRY_LATER if reason.code == "unavailable" else _FAULT
        with contextlib.suppress(TimeoutError, OSError):  # OSError: the client is gone
            async with asyncio.timeout(_SEND_SECONDS):
                self._write(message)
                await self._send_event({"type": "websocket.close", "code": code})
