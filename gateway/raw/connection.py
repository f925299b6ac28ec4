"""One client that runs the policy itself: its packets, and a Transport that only this client uses.

    client thread            reads packets and performs them
    one thread per query     waits for the answers and sends them to the client
    news thread              sends published values and presence changes to the client

If the connection or the transport ends, the other is closed too: the client's presence ends with its connection.
"""

import contextlib
import socket
import threading
from collections import deque
from collections.abc import Callable

from daedalus.gateway.raw.budget import QueryBudget
from daedalus.gateway.raw.clients import MAX_RAW_CLIENTS, ClientTable
from daedalus.gateway.raw.packet_socket import PacketSocket
from daedalus.gateway.raw.packets import MAX_ANSWER_BYTES, Kind, Packet, PacketError, fits_packet, is_own_key
from daedalus.gateway.raw.thread_errors import thread_errors
from daedalus.transport.interface import Inbox, Transport, TransportError

_MAX_DECLARATIONS = 64  # of FOLLOW, WATCH and ANNOUNCE by one client
_MAX_FOLLOWED = 8  # the network keeps the newest value of each followed key in memory
_MAX_CHANGES = 1024  # presence changes that wait for a slow client


class RawConnection:
    """Serves one client from `run` until the connection ends."""

    def __init__(
        self,
        connection: socket.socket,
        open_transport: Callable[[], Transport],
        clients: ClientTable,
        only: str | None = None,
    ) -> None:
        """Construct the connection. `only` is the name that the client may act under; None: the network decides."""
        self._only = only
        self._socket = PacketSocket(connection)
        self._open_transport = open_transport
        self._clients = clients
        self._transport: Transport | None = None
        self._budget = QueryBudget(clients.queries)
        self._changed = threading.Condition()  # guards the next six attributes
        self._closed = False
        self._reason = ""  # why the gateway ended the connection
        self._declared = 0
        self._inboxes: dict[int, tuple[str, Inbox]] = {}  # by the number of the FOLLOW packet
        self._fresh: set[int] = set()  # numbers whose inbox may hold a new value
        self._changes: deque[Packet] = deque()

    def run(self) -> str:
        """Serve the client until it disconnects, `close` or `drop` is called, or it breaks the protocol.

        Returns the reason for which the gateway ended the connection; empty if the client disconnected.
        """
        try:
            if self._socket.greet():
                self._serve()
        except (PacketError, TransportError) as error:
            self._reason = self._reason or str(error)
            with contextlib.suppress(OSError):
                self._socket.send(Packet(Kind.ERROR, 0, payload=str(error).encode()))
        except ConnectionError:
            pass  # the client disconnected with packets unread
        except OSError as error:
            self._reason = self._reason or ("" if self._closed else f"{error}")
        finally:
            self.close()
            self._clients.remove(self)
            self._socket.close()
        return self._reason

    def drop(self, reason: str) -> None:
        """See Client: the client thread then closes the rest."""
        with self._changed:
            self._reason = self._reason or reason
        self._socket.shut_down()

    def close(self) -> None:
        """Close the connection and the transport. Safe from any thread; idempotent."""
        with self._changed:
            self._closed = True
            transport, self._transport = self._transport, None
            self._changed.notify_all()
        self._budget.close()
        self._socket.shut_down()
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

    def _serve(self) -> None:
        if not self._clients.admit(self):
            raise PacketError(f"{MAX_RAW_CLIENTS} clients are connected already: try again later")
        with thread_errors():
            transport = self._open_transport()  # it connects on a thread of its own
        if not self._keep(transport):
            return
        with thread_errors():
            threading.Thread(target=self._send_news, name="raw-news", daemon=True).start()
        while (packet := self._socket.next(lambda size: self._clients.hold(self, size))) is not None:
            self._clients.heard(self)
            self._perform(transport, packet)

    def _perform(self, transport: Transport, packet: Packet) -> None:
        if self._only is not None and not is_own_key(packet.key, self._only):
            raise PacketError(f"this client may act as {self._only} only, not use the key {packet.key}")
        if packet.kind == Kind.QUERY:
            self._start_query(transport, packet)
            return
        self._declared += 1
        if self._declared > _MAX_DECLARATIONS:
            raise PacketError(f"the client followed, watched or announced more than {_MAX_DECLARATIONS} keys")
        number = packet.number
        if packet.kind == Kind.ANNOUNCE:
            transport.declare_presence(packet.key)
        elif packet.kind == Kind.WATCH:
            transport.watch_presence(packet.key, lambda key, present: self._on_presence(number, key, present))
        elif len(self._inboxes) >= _MAX_FOLLOWED:
            raise PacketError(f"the client followed more than {_MAX_FOLLOWED} keys")
        else:
            inbox = transport.subscribe(packet.key, lambda: self._on_news(number))
            with self._changed:
                self._inboxes[number] = packet.key, inbox
            self._on_news(number)  # values that arrived before the inbox had its number

    def _start_query(self, transport: Transport, packet: Packet) -> None:
        if not self._budget.take(len(packet.payload), self._socket.has_gone):
            raise ConnectionAbortedError
        try:
            with thread_errors():
                run, arguments = self._run_query, (transport, packet)
                threading.Thread(target=run, args=arguments, name="raw-query", daemon=True).start()
        except PacketError:
            self._end_query(packet, len(packet.payload))
            raise

    # ---------------------------------------------------------------------------------------- query threads

    def _run_query(self, transport: Transport, packet: Packet) -> None:
        held = len(packet.payload)
        try:
            answers = transport.query(packet.key, packet.payload, timeout=packet.timeout)
            size = sum(map(len, answers))
            self._clients.hold(self, size)
            held += size
            for answer in answers:
                if len(answer) <= MAX_ANSWER_BYTES:
                    self._socket.send(Packet(Kind.ANSWER, packet.number, payload=answer))
            self._socket.send(Packet(Kind.END, packet.number))
        except (OSError, TransportError):
            self.close()  # the connection or the transport has failed
        finally:
            self._end_query(packet, held)

    def _end_query(self, packet: Packet, held: int) -> None:
        self._clients.release(self, held)
        self._budget.give_back(len(packet.payload))

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
            self.drop(f"it did not read {_MAX_CHANGES} changes of presence")

    # ------------------------------------------------------------------------------------------ news thread

    def _send_news(self) -> None:
        try:
            while (packet := self._await_news()) is not None:
                self._clients.hold(self, len(packet.payload))
                self._socket.send(packet)
                self._clients.release(self, len(packet.payload))
        except OSError:
            self.close()

    def _await_news(self) -> Packet | None:
        """Wait for news and return one packet, changes of presence first; return None when the connection is closed."""
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._closed or self._fresh or self._changes)
                if self._closed:
                    return None
                if self._changes:
                    return self._changes.popleft()
                number = self._fresh.pop()
                key, inbox = self._inboxes.get(number, ("", None))
            value = None if inbox is None else inbox.take()
            if value is not None and len(value) <= MAX_ANSWER_BYTES:
                return Packet(Kind.NEWS, number, key, payload=value)
