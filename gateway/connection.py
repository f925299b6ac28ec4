"""One client's WebSocket: reads its messages in turn, and answers them. An ASGI application for one connection."""

import asyncio
import contextlib
import logging
import time
from typing import Any

from daedalus.gateway import messages
from daedalus.gateway.client_actor import ClientActor
from daedalus.gateway.errors import ClientError
from daedalus.gateway.gateway import JOIN_SECONDS, Gateway
from daedalus.gateway.messages import TRANSITIONS, Act, EndEpisode, Hello, Reward, State
from daedalus.gateway.rate_limit import RateLimit
from daedalus.gateway.security import Guard

_logger = logging.getLogger(__name__)

HELLO_SECONDS = 10.0  # from the connection to the hello
_SEND_SECONDS = 5.0  # for the last message
_MAX_FAULTS = 10  # of one client; then it is disconnected
_OK, _FAULT, _TRY_LATER = 1000, 1008, 1013  # codes of RFC 6455


class ClientConnection:
    """The conversation with one client."""

    def __init__(self, gateway: "asyncio.Future[Gateway]", guard: Guard, scope: Any, receive: Any, send: Any) -> None:
        """`gateway` has its result when the network is reached."""
        self._reached, self._guard, self._scope = gateway, guard, scope
        self._receive_event, self._send_event = receive, send
        self._state: State = "new"
        self._as_text = True
        self._end: ClientError | str | None = None  # why the gateway ends the connection
        self._task: asyncio.Task[Any] | None = None
        self._rate = RateLimit()

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
                data = await self._receive()
        except TimeoutError:
            raise ClientError("malformed", f"no hello came within {HELLO_SECONDS:g} s") from None
        if data is None:
            return
        self._as_text = isinstance(data, str)
        hello = messages.read(data, self._state)
        assert isinstance(hello, Hello)
        self._guard.check_token(hello.name, hello.token)
        address = self._address()
        gateway = await self._reach()
        actor = await gateway.admit(hello, address, self.end)
        try:
            self._scope["extensions"]["daedalus.limit"](actor.spaces.max_message_bytes)
            session = gateway.session
            if session is not None:
                await self._send(messages.welcome(session.run, session.spec.environment.id, hello.name))
            _logger.info("client %s connected from %s", actor.name, address)
            self._state = "ready"
            await self._serve_actor(gateway, actor)
        finally:
            gateway.leave(actor)
            _logger.info("client %s disconnected", actor.name)

    async def _reach(self) -> Gateway:
        try:
            async with asyncio.timeout(JOIN_SECONDS):
                return await asyncio.shield(self._reached)
        except TimeoutError:
            raise ClientError("unavailable", f"no learner came within {JOIN_SECONDS:g} s: try again later") from None

    def _address(self) -> str:
        host, port = self._scope.get("client") or ("", 0)
        return f"ws/{host}:{port}"

    async def _serve_actor(self, gateway: Gateway, actor: ClientActor) -> None:
        faults = 0
        while (data := await self._receive()) is not None:
            actor.heard_at = time.monotonic()
            if pause := self._rate.take(actor.heard_at):
                await asyncio.sleep(pause)
            try:
                await self._answer(gateway, actor, messages.read(data, self._state))
            except ClientError as error:
                faults += 1
                if faults == _MAX_FAULTS:
                    raise
                await self._send(messages.error(error))

    async def _answer(self, gateway: Gateway, actor: ClientActor, message: messages.ClientMessage) -> None:
        match message:
            case Act():
                action = await gateway.act(actor, message)
                self._state = TRANSITIONS[self._state, "act"]
                await self._send(messages.action(action))
            case Reward():
                actor.reward(message.reward)
            case EndEpisode():
                actor.end_episode(message)
                self._state = TRANSITIONS[self._state, "end_episode"]

    async def _receive(self) -> str | bytes | None:
        """Return the next message, or None if the client disconnected."""
        event = await self._receive_event()
        if event["type"] == "websocket.disconnect":
            return None
        text = event.get("text")
        return event["bytes"] if text is None else text

    async def _send(self, message: dict[str, Any]) -> None:
        data = messages.encode(message, as_text=self._as_text)
        await self._send_event({"type": "websocket.send", "text" if self._as_text else "bytes": data})

    async def _finish(self, reason: ClientError | str) -> None:
        """Say why the connection ends, and close it."""
        if isinstance(reason, str):
            message, code = messages.run_ended(reason), _OK
        else:
            message, code = messages.error(reason), _TRY_LATER if reason.code == "unavailable" else _FAULT
        with contextlib.suppress(TimeoutError, OSError):  # OSError: the client is gone
            async with asyncio.timeout(_SEND_SECONDS):
                await self._send(message)
                await self._send_event({"type": "websocket.close", "code": code})
