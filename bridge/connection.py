"""One client of the bridge: its connection, and the Transport that it alone uses.

    its own thread      reads packets and does what they ask
    a thread a query    waits for the answers and hands them over
    news thread         hands over what was published, and who came and went

Whatever ends first, the connection or the transport, ends the other: presence lasts as long as the client does.
"""

import contextlib
import select
import socket
import threading
from collections import deque
from collections.abc import Callable

from daedalus.bridge.budget import Budget
from daedalus.bridge.packets import (
    GREETING,
    HEADER_BYTES,
    MAX_ANSWER_BYTES,
    Kind,
    Packet,
    PacketError,
    check_key,
    encode_packet,
    read_header,
)
from daedalus.transport.interface import Inbox, Transport, TransportError

STALL_SECONDS = 30.0  # a client that takes nothing for so long, or stops within a packet, is given up
_MOST_DECLARED = 64  # keys that one client follows, watches or is present under
_MOST_CHANGES = 1024  # of presence, that the client has not taken yet
_CHUNK_BYTES = 64 << 10  # memory is taken for what came, not for what was declared
_KEEP_ALIVE = (("TCP_KEEPIDLE", 5), ("TCP_KEEPINTVL", 5), ("TCP_KEEPCNT", 3))  # a host that vanished is missed by this


class ClientConnection:
    """Serves one connection from `run` to its end."""

    def __init__(self, connection: socket.socket, open_transport: Callable[[], Transport]) -> None:
        self._connection = connection
        self._open_transport = open_transport
        self._transport: Transport | None = None
        self._budget = Budget()
        self._sending = threading.Lock()
        self._changed = threading.Condition()  # guards the next five
        self._closed = False
        self._declared = 0
        self._inboxes: dict[int, tuple[str, Inbox]] = {}  # by number
        self._fresh: set[int] = set()  # whose inbox may have something new
        self._changes: deque[Packet] = deque()

    def run(self) -> str:
        """Serves it until it goes, is told to by `close`, or is given up; says why, or nothing if the client went."""
        try:
            self._connection.settimeout(STALL_SECONDS)
            self._connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            self._connection.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
            for name, value in _KEEP_ALIVE:
                if hasattr(socket, name):
                    self._connection.setsockopt(socket.IPPROTO_TCP, getattr(socket, name), value)
            self._connection.sendall(GREETING)
            if self._read(len(GREETING), begun=True) != GREETING:
                return "it speaks another protocol"
            transport = self._open_transport()
            if not self._keep(transport):
                return ""
            threading.Thread(target=self._pass_on_news, name="bridge-news", daemon=True).start()
            while (packet := self._next()) is not None:
                self._do(transport, packet)
            return ""
        except (PacketError, TransportError) as error:
            with contextlib.suppress(OSError):
                self._send(Packet(Kind.ERROR, 0, payload=str(error).encode()))
            return str(error)
        except ConnectionError:
            return ""  # it went with something unread
        except OSError as error:
            return "" if self._closed else f"{error}"
        finally:
            self.close()
            self._connection.close()

    def close(self) -> None:
        """Ends all that the client has here. From any thread; idempotent."""
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
        """Whether the client is still there for it; closed if not."""
        with self._changed:
            if not self._closed:
                self._transport = transport
                return True
        transport.close()
        return False

    # ----------------------------------------------------------------------------------------- its own thread

    def _next(self) -> Packet | None:
        """The next packet; None if the client went between two."""
        head = self._read(HEADER_BYTES, begun=False)
        if not head:
            return None
        header = read_header(head)
        key = check_key(self._read(header.key_bytes, begun=True), header.kind)
        payload = self._read(header.payload_bytes, begun=True)
        return Packet(header.kind, header.number, key, header.timeout, payload)

    def _read(self, size: int, *, begun: bool) -> bytes:
        """So many bytes; none at all if the client went before the first, and the packet was not `begun`."""
        data = bytearray()
        while len(data) < size:
            try:
                chunk = self._connection.recv(min(size - len(data), _CHUNK_BYTES))
            except TimeoutError:
                if data or begun:
                    raise PacketError(f"no more came within {STALL_SECONDS:g} s") from None
                continue  # it just has nothing to say
            if not chunk and (data or begun):
                raise PacketError("it went in the middle")
            if not chunk:
                return b""
            data += chunk
        return bytes(data)

    def _do(self, transport: Transport, packet: Packet) -> None:
        if packet.kind == Kind.QUERY:
            if not self._budget.take(len(packet.payload), self._has_gone):
                raise ConnectionAbortedError
            threading.Thread(target=self._ask, args=(transport, packet), name="bridge-query", daemon=True).start()
            return
        self._declared += 1
        if self._declared > _MOST_DECLARED:
            raise PacketError(f"more than {_MOST_DECLARED} keys followed, watched or announced")
        number = packet.number
        if packet.kind == Kind.ANNOUNCE:
            transport.declare_presence(packet.key)
        elif packet.kind == Kind.WATCH:
            transport.watch_presence(packet.key, lambda key, present: self._on_presence(number, key, present))
        else:
            inbox = transport.subscribe(packet.key, lambda: self._on_news(number))
            with self._changed:
                self._inboxes[number] = packet.key, inbox
            self._on_news(number)  # what came before the inbox had its number

    def _has_gone(self) -> bool:
        """Whether it closed its end, even if something that it sent before is still unread."""
        poll = select.poll()
        poll.register(self._connection, getattr(select, "POLLRDHUP", 0))
        return bool(poll.poll(0))

    # ------------------------------------------------------------------------------- the threads of its queries

    def _ask(self, transport: Transport, packet: Packet) -> None:
        try:
            for answer in transport.query(packet.key, packet.payload, timeout=packet.timeout):
                if len(answer) <= MAX_ANSWER_BYTES:
                    self._send(Packet(Kind.ANSWER, packet.number, payload=answer))
            self._send(Packet(Kind.END, packet.number))
        except (OSError, TransportError):
            self.close()  # neither of them can be used any more
        finally:
            self._budget.give_back(len(packet.payload))

    def _send(self, packet: Packet) -> None:
        with self._sending:
            self._connection.sendall(encode_packet(packet))

    # ---------------------------------------------------------------------- the transport's threads hand over only

    def _on_news(self, number: int) -> None:
        with self._changed:
            self._fresh.add(number)
            self._changed.notify_all()

    def _on_presence(self, number: int, key: str, present: bool) -> None:
        with self._changed:
            self._changes.append(Packet(Kind.PRESENT if present else Kind.ABSENT, number, key))
            too_slow = len(self._changes) > _MOST_CHANGES
            self._changed.notify_all()
        if too_slow:
            with contextlib.suppress(OSError):
                self._connection.shutdown(socket.SHUT_RDWR)  # the thread that reads it ends all else

    # -------------------------------------------------------------------------------------------- the news thread

    def _pass_on_news(self) -> None:
        try:
            while (packets := self._await_news()) is not None:
                for packet in packets:
                    self._send(packet)
        except OSError:
            self.close()

    def _await_news(self) -> list[Packet] | None:
        """What is new, once there is something; None when closed."""
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
