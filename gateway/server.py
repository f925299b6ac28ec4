"""The web server of a gateway: uvicorn with our limits."""

import asyncio
import contextlib
import functools
import itertools
import logging
import socket
import ssl
import time
import traceback
from asyncio.transports import BaseTransport
from collections.abc import Awaitable, Callable, Iterator
from pathlib import Path
from typing import Any

import h11
import uvicorn
from uvicorn.protocols.http.h11_impl import H11Protocol
from uvicorn.protocols.websockets.websockets_sansio_impl import WebSocketsSansIOProtocol
from uvicorn.server import ServerState
from websockets.exceptions import InvalidState
from websockets.frames import CloseCode, Frame
from websockets.http11 import Request as HandshakeRequest

from daedalus.gateway.app import Application
from daedalus.gateway.client_messages import MAX_HELLO_BYTES
from daedalus.gateway.places import most_connections, network_of, peer_of
from daedalus.transport.credentials import CERTIFICATE, KEY

_logger = logging.getLogger(__name__)

_PING_SECONDS = 10.0  # a client that does not answer a ping for as long is disconnected
_MAX_NEWCOMERS = 128  # WebSockets that hold a large part of a first message
_SMALL_HELLO_BYTES = 16 << 10
_STOP_SECONDS = 2  # for connections to end after a stop
_QUEUED_MESSAGES = 8  # of one client, before reading pauses
_MAX_FRAGMENTS = 4096  # of one message: the limit on its bytes does not count empty ones
_ACCEPT_SECONDS = 0.05  # after an error, before the next connection is accepted
_ACCEPTED_AT_ONCE = 16  # then others run
_LINE_SECONDS, _LINE_CHARACTERS = 5.0, 300  # between lines about what the libraries log; of one
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


class Link:
    """One connection, from its acceptance to its end."""

    def __init__(self, address: str, end: Callable[[], object]) -> None:
        """`end` ends it at once."""
        self.network, self.end = network_of(address), end


class Crowd:
    """All connections. Up to a quarter have no place; then the oldest of these ends, of the address with the most.

    Over TLS asyncio takes about 300 KB for a connection, also for one that says nothing.
    """

    def __init__(self) -> None:
        self._settled: set[Link] = set()
        self._others: dict[str, dict[Link, None]] = {}  # by address, the oldest first

    def add(self, link: Link) -> None:
        """Add a new connection, or one whose request was answered."""
        self.remove(link)
        most = most_connections()
        while (others := sum(map(len, self._others.values()))) >= most // 4 or others + len(self._settled) >= most:
            if not self.make_room():
                break
        self._others.setdefault(link.network, {})[link] = None

    def settle(self, link: Link) -> None:
        """Note that a connection has a place."""
        self.remove(link)
        self._settled.add(link)

    def remove(self, link: Link) -> None:
        """Forget a connection. Idempotent."""
        self._settled.discard(link)
        others = self._others.get(link.network, {})
        others.pop(link, None)
        if not others:
            self._others.pop(link.network, None)

    def make_room(self) -> bool:
        """End a connection; return whether there was one without a place."""
        largest = max(self._others.values(), key=len, default=None)
        if largest is None:
            return False
        oldest = next(iter(largest))
        self.remove(oldest)
        oldest.end()
        return True


class _Config(uvicorn.Config):
    """Settings of one server, and what its connections share."""

    newcomers: _Newcomers
    crowd: Crowd


class PromptHttp(H11Protocol):
    """HTTP for clients that send a request soon, and read its answer."""

    _deadline: asyncio.TimerHandle | None = None  # it keeps the connection, with all that was received

    config: _Config

    def __init__(self, config: _Config, server_state: ServerState, link: Link) -> None:
        super().__init__(config, server_state, {})
        self._link = link
        self.ws_protocol_class = functools.partial(OurWebSocket, link)  # type: ignore[assignment] - it makes one

    def connection_made(self, transport: BaseTransport) -> None:
        """End the connection if no request comes."""
        super().connection_made(transport)  # type: ignore[arg-type] - it is a transport that writes
        self._link.end = self._abort
        self._begin_deadline()

    def on_response_complete(self) -> None:
        """End the connection if no further request comes. uvicorn's own deadline ends with the next byte."""
        self._begin_deadline()
        self.config.crowd.add(self._link)
        super().on_response_complete()

    def connection_lost(self, exc: Exception | None) -> None:
        """Free the memory of the connection."""
        super().connection_lost(exc)
        self._end_deadline()
        self.config.crowd.remove(self._link)

    def handle_websocket_upgrade(self, event: h11.Request) -> None:
        """Let the WebSocket have its own deadlines."""
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

    def __init__(self, link: Link, config: _Config, server_state: ServerState, app_state: dict[str, Any]) -> None:
        super().__init__(config, server_state, app_state)
        self._link = link

    def connection_made(self, transport: BaseTransport) -> None:
        """Take the connection over from HTTP."""
        super().connection_made(transport)
        self._link.end = self.transport.abort

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
        self.config.crowd.remove(self._link)

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
        if self.close_sent:
            self.frames = []
            return
        if self.curr_msg_data_type == "text":
            data = b"".join(self.frames)
            try:
                self.frames = [data]
                text = data.decode()
            except UnicodeDecodeError:
                self.frames = []
                self.conn.fail(CloseCode.INVALID_DATA, "a text is not UTF-8")
                self.handle_parser_exception()
                return
            if self._on_message is not None:
                self.frames = []
                self._on_message(text)
                return
        elif self._on_message is not None:
            data, self.frames = b"".join(self.frames), []
            self._on_message(data)
            return
        paused = self.read_paused
        self.read_paused = paused or self.queue.qsize() < _QUEUED_MESSAGES
        super().send_receive_event_to_app()
        self.read_paused = paused or self.queue.qsize() > _QUEUED_MESSAGES

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

    @property
    def peer(self) -> str:
        """See Channel."""
        local, remote = self.transport.get_extra_info("sockname"), self.transport.get_extra_info("peername")
        return peer_of(str((remote or [""])[0]), local, remote)

    def settle(self, settled: bool) -> None:
        """See Channel."""
        if not self.disconnected:
            (self.config.crowd.settle if settled else self.config.crowd.add)(self._link)

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

    def acknowledge(self) -> None:
        """See Channel. Without TCP_NODELAY a client's system sends a small message only when the last is acknowledged,
        which ours delays by 40 ms.
        """
        with contextlib.suppress(OSError, AttributeError):  # a closed connection, or a system other than Linux
            self.transport.get_extra_info("socket").setsockopt(socket.IPPROTO_TCP, socket.TCP_QUICKACK, 1)

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
            timeout_graceful_shutdown=_STOP_SECONDS,
            lifespan="off",
            log_config=None,
            access_log=False,
            server_header=False,
            proxy_headers=False,
        )
        config.newcomers, config.crowd = _Newcomers(), Crowd()
        config.load()
        config.ssl = tls
        for name in ("uvicorn", "websockets", "asyncio"):
            logger = logging.getLogger(name)
            logger.setLevel(logging.WARNING)
            logger.handlers, logger.propagate = [OneLine()], False
        super().__init__(config)
        self.config: _Config = config
        self._accepting: asyncio.Task[None] | None = None
        self._beginning: set[asyncio.Task[None]] = set()  # connections whose TLS handshake is not complete

    @contextlib.contextmanager
    def capture_signals(self) -> Iterator[None]:
        """Capture none."""
        yield

    async def startup(self, sockets: list[socket.socket] | None = None) -> None:
        """Listen, and count each connection from its first moment on: asyncio's server does so after the handshake."""
        await self.lifespan.startup()
        self.servers = []
        (listener,) = sockets or []
        self._accepting = asyncio.create_task(self._accept(listener))
        self.started = True

    async def shutdown(self, sockets: list[socket.socket] | None = None) -> None:
        """End the connections."""
        ending = [task for task in (self._accepting, *self._beginning) if task is not None]
        for task in ending:
            task.cancel()
        await asyncio.gather(*ending, return_exceptions=True)
        await super().shutdown(sockets)

    async def _accept(self, listener: socket.socket) -> None:
        loop = asyncio.get_running_loop()
        listener.setblocking(False)
        for number in itertools.count():
            try:
                connection, address = await loop.sock_accept(listener)
            except OSError:  # the client has gone, or the system has no descriptor for it
                self.config.crowd.make_room()
                await asyncio.sleep(_ACCEPT_SECONDS)
                continue
            link = Link(str(address[0]), functools.partial(_shut_down, connection))
            self.config.crowd.add(link)
            task = asyncio.create_task(self._begin(connection, link))
            self._beginning.add(task)
            task.add_done_callback(self._beginning.discard)
            if number % _ACCEPTED_AT_ONCE == 0:
                await asyncio.sleep(0)  # `sock_accept` does not let others run while connections wait

    async def _begin(self, connection: socket.socket, link: Link) -> None:
        """Perform the TLS handshake, in a limited time: asyncio's is 60 s. HTTP goes on from there."""
        config, state = self.config, self.server_state
        limit = None if config.ssl is None else _REQUEST_SECONDS
        try:
            await asyncio.get_running_loop().connect_accepted_socket(
                lambda: PromptHttp(config, state, link), connection, ssl=config.ssl, ssl_handshake_timeout=limit
            )
        except OSError:
            config.crowd.remove(link)
            connection.close()

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


def _shut_down(connection: socket.socket) -> None:
    with contextlib.suppress(OSError):  # it has ended
        connection.shutdown(socket.SHUT_RDWR)


class OneLine(logging.Handler):
    """Handler of what the libraries of the server log: one line without a traceback, and few lines in all.

    Most records tell of a client that breaks a protocol, and a client can do so as often as it likes.
    """

    def __init__(self) -> None:
        super().__init__()
        self.next_at, self._left_out = 0.0, 0  # the monotonic time of the next line

    def emit(self, record: logging.LogRecord) -> None:
        """See logging.Handler."""
        now = time.monotonic()
        if now < self.next_at:
            self._left_out += 1
            return
        error = record.exc_info[1] if record.exc_info else None
        at = traceback.extract_tb(error.__traceback__)[-1:] if error else []
        cause = f": {type(error).__name__}: {error}" if error else ""
        where = "".join(f" ({Path(frame.filename).name}:{frame.lineno})" for frame in at)
        more = f" ({self._left_out} records before this one were left out)" if self._left_out else ""
        text = " ".join(f"{record.getMessage().strip()}{cause}".split())[:_LINE_CHARACTERS]
        _logger.log(record.levelno, "%s", f"{text}{where}{more}")
        self.next_at, self._left_out = now + _LINE_SECONDS, 0


def tls_context(directory: Path) -> ssl.SSLContext:
    """Return the settings of a server with the certificate in a folder."""
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    context.minimum_version = ssl.TLSVersion.TLSv1_2
    context.load_cert_chain(directory / CERTIFICATE, directory / KEY)
    # A client that reads in a thread of its own receives TLS 1.3's tickets while it sends its first request. OpenSSL
    # does not support both at once: about one request in a hundred was never sent.
    context.num_tickets = 0
    return context
