"""The web server of a gateway: uvicorn with our limits."""

import asyncio
import contextlib
import logging
import socket
import ssl
from asyncio.transports import BaseTransport
from collections.abc import Awaitable, Callable, Iterator
from pathlib import Path

import h11
import uvicorn
from uvicorn.protocols.http.h11_impl import H11Protocol
from uvicorn.protocols.websockets.websockets_sansio_impl import WebSocketsSansIOProtocol
from websockets.exceptions import InvalidState
from websockets.frames import CloseCode, Frame
from websockets.http11 import Request as HandshakeRequest

from daedalus.gateway.app import Application
from daedalus.gateway.messages import MAX_HELLO_BYTES
from daedalus.transport.credentials import CERTIFICATE, KEY

_PING_SECONDS = 10.0  # a client that does not answer a ping for as long is disconnected
_MAX_CONNECTIONS = 2048
_MAX_NEWCOMERS = 128  # WebSockets that hold a large part of a first message
_SMALL_HELLO_BYTES = 16 << 10
_STOP_SECONDS = 2  # for connections to end after a stop
_QUEUED_MESSAGES = 8  # of one client, before reading pauses
_MAX_FRAGMENTS = 4096  # of one message: the limit on its bytes does not count empty ones
_REQUEST_SECONDS = 10.0  # from the connection, or the last answer, to the end of the next answer; and for a handshake


class _Newcomers:
    """The WebSockets whose first message is large and not complete yet; the oldest is ended if there are too many."""

    def __init__(self) -> None:
        self._waiting: dict[OurWebSocket, None] = {}  # oldest first

    def add(self, connection: "OurWebSocket") -> None:
        if len(self._waiting) >= _MAX_NEWCOMERS:
            oldest = next(iter(self._waiting))
            del self._waiting[oldest]
            oldest.transport.abort()
        self._waiting[connection] = None

    def remove(self, connection: "OurWebSocket") -> None:
        self._waiting.pop(connection, None)


class _Config(uvicorn.Config):
    """Settings of one server, and what its connections share."""

    newcomers: _Newcomers


class PromptHttp(H11Protocol):
    """HTTP for clients that send a request soon, and read its answer."""

    _deadline: asyncio.TimerHandle | None = None  # it keeps the connection, with all that was received

    def connection_made(self, transport: BaseTransport) -> None:
        """End the connection if no request comes."""
        super().connection_made(transport)  # type: ignore[arg-type] - it is a transport that writes
        self._begin_deadline()

    def on_response_complete(self) -> None:
        """End the connection if no further request comes. uvicorn's own deadline ends with the next byte."""
        self._begin_deadline()
        super().on_response_complete()

    def connection_lost(self, exc: Exception | None) -> None:
        """Free the memory of the connection."""
        super().connection_lost(exc)
        self._end_deadline()

    def handle_websocket_upgrade(self, event: h11.Request) -> None:
        """Let the WebSocket have its own deadlines. uvicorn's limit on connections is for other requests only."""
        if len(self.connections) > _MAX_CONNECTIONS:
            self._abort()
            return
        self._end_deadline()
        super().handle_websocket_upgrade(event)

    def _begin_deadline(self) -> None:
        self._end_deadline()
        self._deadline = self.loop.call_later(_REQUEST_SECONDS, self._abort)

    def _end_deadline(self) -> None:
        if self._deadline is not None:
            self._deadline.cancel()

    def _abort(self) -> None:
        self.transport.abort()  # `close` waits until the client has read everything


class OurWebSocket(WebSocketsSansIOProtocol):
    """A WebSocket that is a Channel (channel.py) to the application."""

    _on_message: Callable[[str | bytes], None] | None = None  # after `divert`
    _on_writable: Callable[[], None] | None = None
    _is_new, _received = True, 0  # before the first message; bytes of it

    config: _Config

    def data_received(self, data: bytes) -> None:
        """Note how much of the first message has come."""
        if self._is_new:
            self._received += len(data)
            if self._received > _SMALL_HELLO_BYTES:
                self._is_new = False
                self.config.newcomers.add(self)
        super().data_received(data)

    def connection_lost(self, exc: Exception | None) -> None:
        """Free the memory of the connection."""
        super().connection_lost(exc)
        self.config.newcomers.remove(self)

    def handle_connect(self, event: HandshakeRequest) -> None:
        """Give the application the channel."""
        super().handle_connect(event)
        if self.response.status_code == 101:
            self.scope["extensions"] = {**(self.scope["extensions"] or {}), "daedalus": self}  # type: ignore[typeddict-item] - extensions may have any name

    def handle_cont(self, event: Frame) -> None:
        """End the connection if a message has too many fragments."""
        if len(self.frames) < _MAX_FRAGMENTS:
            super().handle_cont(event)
        elif not self.close_sent:
            self.conn.fail(CloseCode.MESSAGE_TOO_BIG, f"a message has more than {_MAX_FRAGMENTS} fragments")
            self.handle_parser_exception()

    def send_receive_event_to_app(self) -> None:
        """Deliver a message; pause reading only if the application is behind, which costs two system calls."""
        self._is_new = False
        self.config.newcomers.remove(self)
        if self._on_message is not None and not self.close_sent:
            self._deliver(self._on_message)
            return
        paused = self.read_paused
        self.read_paused = paused or self.queue.qsize() < _QUEUED_MESSAGES
        super().send_receive_event_to_app()
        self.read_paused = paused or self.queue.qsize() > _QUEUED_MESSAGES

    def _deliver(self, on_message: Callable[[str | bytes], None]) -> None:
        data = self.frames[0] if len(self.frames) == 1 else b"".join(self.frames)
        if self.curr_msg_data_type == "bytes":
            message: str | bytes = data
        else:
            try:
                message = data.decode()
            except UnicodeDecodeError:
                self._on_message = None  # uvicorn closes the connection
                super().send_receive_event_to_app()
                return
        self.frames = []
        on_message(message)

    def keepalive_timeout(self) -> None:
        """End the connection of a client that does not answer a ping, although it may not read what was written."""
        super().keepalive_timeout()
        self.transport.abort()  # `close` waits until the client has read everything

    def resume_writing(self) -> None:
        """Tell the application that the client reads again."""
        super().resume_writing()
        if self._on_writable is not None:
            self._on_writable()

    def limit(self, size: int) -> None:
        """See Channel."""
        self.conn.max_message_size = size

    def divert(self, on_message: Callable[[str | bytes], None], on_writable: Callable[[], None]) -> None:
        """See Channel."""
        queued = [self.queue.get_nowait() for _ in range(self.queue.qsize())]
        self._on_message, self._on_writable = on_message, on_writable
        self.pause(False)
        for event in queued:
            if event["type"] == "websocket.receive":
                text = event.get("text")
                on_message(event.get("bytes") or b"" if text is None else text)
            else:
                self.queue.put_nowait(event)

    @property
    def is_writable(self) -> bool:
        """See Channel."""
        return self.writable.is_set()

    def write(self, data: str | bytes) -> None:
        """See Channel."""
        if self.close_sent or self.transport.is_closing():
            return
        with contextlib.suppress(InvalidState):  # the client has closed the connection
            if isinstance(data, str):
                self.conn.send_text(data.encode())
            else:
                self.conn.send_binary(data)
            self.transport.write(b"".join(self.conn.data_to_send()))

    def pause(self, paused: bool) -> None:
        """See Channel."""
        if paused != self.read_paused and not self.transport.is_closing():
            self.read_paused = paused
            (self.transport.pause_reading if paused else self.transport.resume_reading)()


class Server(uvicorn.Server):
    """A web server that serves until it is asked to stop, and leaves signals to its caller."""

    def __init__(self, application: Application, tls: ssl.SSLContext | None = None) -> None:
        config = _Config(
            application,
            http=PromptHttp,
            ws=OurWebSocket,
            ws_max_size=MAX_HELLO_BYTES,
            ws_per_message_deflate=False,
            ws_ping_interval=_PING_SECONDS,
            ws_ping_timeout=_PING_SECONDS,
            limit_concurrency=_MAX_CONNECTIONS,
            timeout_graceful_shutdown=_STOP_SECONDS,
            lifespan="off",
            log_config=None,
            access_log=False,
            server_header=False,
            proxy_headers=False,
        )
        config.newcomers = _Newcomers()
        config.load()
        config.ssl = tls
        logging.getLogger("uvicorn").setLevel(logging.WARNING)
        super().__init__(config)

    @contextlib.contextmanager
    def capture_signals(self) -> Iterator[None]:
        """Capture none."""
        yield

    async def startup(self, sockets: list[socket.socket] | None = None) -> None:
        """Listen, as uvicorn's own method does, with a time limit for TLS handshakes: asyncio's is 60 s."""
        loop, config = asyncio.get_running_loop(), self.config
        limit = None if config.ssl is None else _REQUEST_SECONDS
        await self.lifespan.startup()
        self.servers = [
            await loop.create_server(
                lambda: PromptHttp(config, self.server_state, {}),
                sock=listener,
                ssl=config.ssl,
                ssl_handshake_timeout=limit,
                backlog=config.backlog,
            )
            for listener in sockets or []
        ]
        self.started = True

    async def run_until(
        self, stop: asyncio.Event, listener: socket.socket, on_stop: Callable[[], Awaitable[None]]
    ) -> None:
        """Serve until `stop` is set, then await `on_stop`, which may still send, and close all connections."""
        ends = [asyncio.ensure_future(self.serve([listener])), asyncio.ensure_future(stop.wait())]
        await asyncio.wait(ends, return_when=asyncio.FIRST_COMPLETED)
        await on_stop()
        self.should_exit = True
        ends[1].cancel()
        await ends[0]
        for connection in list(self.server_state.connections):  # of clients that did not close theirs in time
            connection.transport.abort()
        await asyncio.sleep(0)  # the loop ends them now


def tls_context(directory: Path) -> ssl.SSLContext:
    """Return the settings of a server with the certificate in a folder."""
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    context.minimum_version = ssl.TLSVersion.TLSv1_2
    context.load_cert_chain(directory / CERTIFICATE, directory / KEY)
    # A client that reads in a thread of its own receives TLS 1.3's tickets while it sends its first request. OpenSSL
    # does not support both at once: about one request in a hundred was never sent.
    context.num_tickets = 0
    return context
