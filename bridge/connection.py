"""One client of the bridge: its TCP connection, and a Transport that only this client uses.

    client thread            reads packets and performs them
    one thread per query     waits for the answers and sends them to the client
    news thread              sends published values and presence changes to the client

If the connection or the transport ends, the other is closed too: the client's presence ends with its connection.
"""

import contextlib
import select
import socket
import threading
from collections import deque
from collections.abc import Callable

from daedalus.bridge.budget import QueryBudget
from daedalus.bridge.packets import (
    GREETING,
    HEADER_BYTES,
    MAX_ANSWER_BYTES,
    Kind,
    Packet,
    PacketError,
    check_key,
    encode_packet,
    fits_packet,
    read_header,
)
from daedalus.transport.interface import Inbox, Transport, TransportError

STALL_SECONDS = 30.0  # a client that stalls for longer, or stops within a packet, is disconnected
_MAX_DECLARATIONS = 64  # of FOLLOW, WATCH and ANNOUNCE by one client
_MAX_CHANGES = 1024  # presence changes that wait for a slow client
_CHUNK_BYTES = 64 << 10  # allocate memory for bytes received, not for bytes declared
_KEEP_ALIVE = (("TCP_KEEPIDLE", 5), ("TCP_KEEPINTVL", 5), ("TCP_KEEPCNT", 3))  # detects a host that vanished


class ClientConnection:
    """Serves one client from `run` until the connection ends."""

    def __init__(self, connection: socket.socket, open_transport: Callable[[], Transport]) -> None:
        self._connection = connection
        self._open_transport = open_transport
        self._transport: Transport | None = None
        self._budget = QueryBudget()
        self._sending = threading.Lock()
        self._changed = threading.Condition()  # guards the next five attributes
        self._closed = False
        self._declared = 0
        self._inboxes: dict[int, tuple[str, Inbox]] = {}  # by the number of the FOLLOW packet
        self._fresh: set[int] = set()  # numbers whose inbox may hold a new value
        self._changes: deque[Packet] = deque()

    def run(self) -> str:
        """Serve the client until it disconnects, `close` is called, or it breaks the protocol.

        Returns the reason for which the bridge ended the connection; empty if the client disconnected.
        """
        try:
            self._connection.settimeout(STALL_SECONDS)
            self._connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            self._connection.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
            for name, value in _KEEP_ALIVE:
                if hasattr(socket, name):
                    self._connection.setsockopt(socket.IPPROTO_TCP, getattr(socket, name), value)
            self._connection.sendall(GREETING)
            if self._read(len(GREETING), begun=True) != GREETING:
                return "the client uses another protocol"
            transport = self._open_transport()
            if not self._keep(transport):
                return ""
            threading.Thread(target=self._send_news, name="bridge-news", daemon=True).start()
            while (packet := self._next()) is not None:
                self._perform(transport, packet)
            return ""
        except (PacketError, TransportError) as error:
            with contextlib.suppress(OSError):
                self._send(Packet(Kind.ERROR, 0, payload=str(error).encode()))
            return str(error)
        except ConnectionError:
            return ""  # the client disconnected with packets unread
        except OSError as error:
            return "" if self._closed else f"{error}"
        finally:
            self.close()
            self._connection.close()

    def close(self) -> None:
        """Close the connection and the transport. Safe from any thread; idempotent."""
        with self._changed:
            self._closed = True
            transport, self._transport = self._transport, None
            self._changed.notify_all()
        self._budget.close()
        with contextlib.suppress(OSError):
            self._connection.shutdown(socket.SHUT_RDWR)
        if transport is not None:
            transport.close()

    def _keep(self, transport: Transport) -> bool:
        """Use a new transport; close it and return False if the connection was closed meanwhile."""
        with self._changed:
            if not self._closed:
                self._transport = transport
                return True
        transport.close()
        return False

    # ---------------------------------------------------------------------------------------- client thread

    def _next(self) -> Packet | None:
        """Return the next packet, or None if the client disconnected between two packets."""
        head = self._read(HEADER_BYTES, begun=False)
        if not head:
            return None
        header = read_header(head)
        key = check_key(self._read(header.key_bytes, begun=True), header.kind)
        payload = self._read(header.payload_bytes, begun=True)
        return Packet(header.kind, header.number, key, header.timeout, payload)

    def _read(self, size: int, *, begun: bool) -> bytes:
        """Return exactly `size` bytes.

        Returns b"" if the client disconnects before the first byte and the packet was not `begun`. Raises PacketError
        if the client stalls or disconnects within a packet.
        """
        data = bytearray()
        while len(data) < size:
            try:
                chunk = self._connection.recv(min(size - len(data), _CHUNK_BYTES))
            except TimeoutError:
                if data or begun:
                    raise PacketError(f"the client sent nothing for {STALL_SECONDS:g} s within a packet") from None
                continue  # the client is idle between packets
            if not chunk and (data or begun):
                raise PacketError("the client disconnected within a packet")
            if not chunk:
                return b""
            data += chunk
        return bytes(data)

    def _perform(self, transport: Transport, packet: Packet) -> None:
        if packet.kind == Kind.QUERY:
            if not self._budget.take(len(packet.payload), self._has_gone):
                raise ConnectionAbortedError
            threading.Thread(target=self._run_query, args=(transport, packet), name="bridge-query", daemon=True).start()
            return
        self._declared += 1
        if self._declared > _MAX_DECLARATIONS:
            raise PacketError(f"the client followed, watched or announced more than {_MAX_DECLARATIONS} keys")
        number = packet.number
        if packet.kind == Kind.ANNOUNCE:
            transport.declare_presence(packet.key)
        elif packet.kind == Kind.WATCH:
            transport.watch_presence(packet.key, lambda key, present: self._on_presence(number, key, present))
        else:
            inbox = transport.subscribe(packet.key, lambda: self._on_news(number))
            with self._changed:
                self._inboxes[number] = packet.key, inbox
            self._on_news(number)  # values that arrived before the inbox had its number

    def _has_gone(self) -> bool:
        """Return whether the client closed its end, even if bytes that it sent before are still unread."""
        poll = select.poll()
        poll.register(self._connection, getattr(select, "POLLRDHUP", 0))
        return bool(poll.poll(0))

    # ---------------------------------------------------------------------------------------- query threads

    def _run_query(self, transport: Transport, packet: Packet) -> None:
        try:
            for answer in transport.query(packet.key, packet.payload, timeout=packet.timeout):
                if len(answer) <= MAX_ANSWER_BYTES:
                    self._send(Packet(Kind.ANSWER, packet.number, payload=answer))
            self._send(Packet(Kind.END, packet.number))
        except (OSError, TransportError):
            self.close()  # the connection or the transport has failed
        finally:
            self._budget.give_back(len(packet.payload))

    def _send(self, packet: Packet) -> None:
        with self._sending:
            self._connection.sendall(encode_packet(packet))

    # ------------------------------------------------------------------ callbacks on the transport's threads

    def _on_news(self, number: int) -> None:
        with self._changed:
            self._fresh.add(number)
            self._changed.notify_all()

    def _on_presence(self, number: int, key: str, present: bool) -> None:
        if not fits_packet(key):
            return  # another process declared it: no actor or learner of ours has such a key
        with self._changed:
            self._changes.append(Packet(Kind.PRESENT if present else Kind.ABSENT, number, key))
            too_slow = len(self._changes) > _MAX_CHANGES
            self._changed.notify_all()
        if too_slow:
            with contextlib.suppress(OSError):
                self._connection.shutdown(socket.SHUT_RDWR)  # wakes the client thread, which closes the rest

    # ------------------------------------------------------------------------------------------ news thread

    def _send_news(self) -> None:
        try:
            while (packets := self._await_news()) is not None:
                for packet in packets:
                    self._send(packet)
        except OSError:
            self.close()

    def _await_news(self) -> list[Packet] | None:
        """Wait for news and return it as packets; return None when the connection is closed."""
        with self._changed:
            self._changed.wait_for(lambda: self._closed or self._fresh or self._changes)
            if self._closed:
                return None
            packets = list(self._changes)
            self._changes.clear()
            followed = [(number, *self._inboxes[number]) for number in self._fresh if number in self._inboxes]
            self._fresh.clear()
        for number, key, inbox in followed:
            value = inbox.take()
            if value is not None and len(value) <= MAX_ANSWER_BYTES:
                packets.append(Packet(Kind.NEWS, number, key, payload=value))
        return packets
