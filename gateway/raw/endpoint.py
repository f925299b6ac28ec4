"""The WebSockets of clients that run the policy themselves: each carries a stream of packets (packets.py).

A socket pair joins the event loop, which moves bytes, and the thread of the client (connection.py).
"""

import asyncio
import contextlib
import logging
import socket
import threading
from collections.abc import Callable
from typing import Any

from daedalus.gateway import messages
from daedalus.gateway.channel import channel_of
from daedalus.gateway.errors import ClientError
from daedalus.gateway.raw.clients import ClientTable
from daedalus.gateway.raw.connection import RawConnection
from daedalus.gateway.raw.packets import PacketError
from daedalus.gateway.raw.thread_errors import thread_errors
from daedalus.gateway.security import Guard
from daedalus.transport.interface import Transport

_logger = logging.getLogger(__name__)

MAX_CHUNK_BYTES = 1 << 20  # of the stream in one WebSocket message: packets may be larger
_HELLO_SECONDS = 10.0
_READ_BYTES = 256 << 10
_END_SECONDS = 2.0


class RawEndpoint:
    """All clients at /raw. Each gets its own transport."""

    def __init__(self, open_transport: Callable[[], Transport], guard: Guard, actor_name: Callable[[str], str]) -> None:
        """Construct the endpoint.

        Args:
          open_transport: connects to the network.
          guard: who may connect.
          actor_name: returns the name of a client towards the learner. Raises ClientError.
        """
        self._open_transport, self._guard, self._actor_name = open_transport, guard, actor_name
        self._table = ClientTable()
        self._clients: set[RawConnection] = set()  # whose threads have not ended

    async def serve(self, scope: Any, receive: Any, send: Any) -> None:
        """Serve one client until one side ends the connection."""
        await receive()  # the request to connect
        await send({"type": "websocket.accept"})
        try:
            name = await self._greet(receive)
            if name is None:
                return
            client, ours = self._begin(name)
        except ClientError as error:
            await send({"type": "websocket.send", "text": messages.encode(messages.error(error), as_text=True)})
            await send({"type": "websocket.close", "code": 1013 if error.code == "unavailable" else 1008})
            return
        try:
            channel_of(scope).become_stream(MAX_CHUNK_BYTES)
            await _carry(ours, receive, send)
        finally:
            client.drop("")  # its thread closes the transport, for which it may have to wait

    def _begin(self, name: str) -> tuple[RawConnection, socket.socket]:
        """Return a client with its thread, and our end of its socket. Raises ClientError."""
        ours, theirs = socket.socketpair()
        only = name if self._guard.tokens is not None else None
        client = RawConnection(theirs, self._open_transport, self._table, only)
        self._table.connect(client)
        self._clients.add(client)
        try:
            with thread_errors():
                threading.Thread(target=self._run, args=(client, name), name="raw-client", daemon=True).start()
        except PacketError as error:
            ours.close()
            theirs.close()
            self._table.remove(client)
            self._clients.discard(client)
            raise ClientError("unavailable", str(error)) from None
        return client, ours

    async def _greet(self, receive: Any) -> str | None:
        """Return the name of a client that may connect; None if it disconnected."""
        try:
            async with asyncio.timeout(_HELLO_SECONDS):
                event = await receive()
        except TimeoutError:
            raise ClientError("malformed", f"no hello came within {_HELLO_SECONDS:g} s") from None
        if event["type"] == "websocket.disconnect":
            return None
        name, token = messages.read_raw_hello(event.get("text") or "")
        self._guard.check_token(name, token)
        return self._actor_name(name)

    def _run(self, client: RawConnection, name: str) -> None:
        _logger.info("%s exchanges messages of the wire", name)
        try:
            reason = client.run()
        finally:
            self._clients.discard(client)
        if reason:
            _logger.warning("%s was disconnected: %s", name, reason)
        else:
            _logger.info("%s disconnected", name)

    async def close(self) -> None:
        """Close all connections."""
        for client in list(self._clients):
            await asyncio.to_thread(client.close)
        deadline = asyncio.get_running_loop().time() + _END_SECONDS
        while self._clients and asyncio.get_running_loop().time() < deadline:
            await asyncio.sleep(0.01)


async def _carry(ours: socket.socket, receive: Any, send: Any) -> None:
    """Move bytes between a WebSocket and the socket of the client's thread, until one of them ends."""
    reader, writer = await asyncio.open_connection(sock=ours)
    up = asyncio.create_task(_pass_up(receive, writer))
    try:
        while data := await reader.read(_READ_BYTES):
            await send({"type": "websocket.send", "bytes": data})
        await send({"type": "websocket.close", "code": 1000})
    except OSError:
        pass  # the client disconnected
    finally:
        up.cancel()
        writer.close()


async def _pass_up(receive: Any, writer: asyncio.StreamWriter) -> None:
    """Pass what the client sends to its thread; TCP's flow control makes a fast client wait."""
    with contextlib.suppress(OSError):
        while (event := await receive())["type"] != "websocket.disconnect":
            writer.write(event.get("bytes") or b"")
            await writer.drain()
    writer.close()
