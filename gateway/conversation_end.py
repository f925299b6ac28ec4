"""How a conversation over a WebSocket ends: by the client, by an error, or because the gateway ends it."""

import asyncio
import contextlib
from abc import ABC, abstractmethod
from collections.abc import Coroutine
from typing import Any

from daedalus.gateway import client_messages
from daedalus.gateway.channel import SEND_SECONDS, channel_of
from daedalus.gateway.client_messages import ClientError

_OK, _FAULT, _TRY_LATER = 1000, 1008, 1013  # codes of RFC 6455


class Connection(ABC):
    """One WebSocket. An ASGI application."""

    def __init__(self, scope: Any, send: Any) -> None:
        self._channel, self._send_event = channel_of(scope), send
        self._end: ClientError | str | None = None  # why the gateway ends the connection
        self._task: asyncio.Task[Any] | None = None

    def end(self, reason: ClientError | str) -> None:
        """End the connection, with an error or with how the run ended. Idempotent."""
        if self._end is None and self._task is not None:
            self._end = reason
            self._task.cancel()

    async def _until_end(self, conversation: Coroutine[Any, Any, None]) -> None:
        """Await a conversation. If it ends with an error, or the gateway ends it, say why, and close the connection."""
        self._task = asyncio.current_task()
        try:
            await conversation
        except asyncio.CancelledError:
            if self._end is None or self._task is None:
                raise
            self._task.uncancel()
            await self._finish(self._end)
        except ClientError as error:
            await self._finish(error)

    async def _finish(self, reason: ClientError | str) -> None:
        self._channel.settle(False)
        if isinstance(reason, str):
            message, code = client_messages.run_ended(reason), _OK
        else:
            message, code = client_messages.error(reason), _TRY_LATER if reason.code == "unavailable" else _FAULT
        with contextlib.suppress(TimeoutError, OSError):  # OSError: the client is gone
            async with asyncio.timeout(SEND_SECONDS):
                await self._send(message)
                await self._send_event({"type": "websocket.close", "code": code})

    @abstractmethod
    async def _send(self, message: dict[str, Any]) -> None: ...
