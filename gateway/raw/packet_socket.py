"""Packets over one socket, with a deadline for each step. One thread reads; any thread may send."""

import contextlib
import select
import socket
import threading
import time
from collections.abc import Callable

from daedalus.gateway.raw.packets import (
    GREETING,
    HEADER_BYTES,
    Packet,
    PacketError,
    check_key,
    encode_head,
    read_header,
)

HANDSHAKE_SECONDS = 10.0  # from the connection to the first packet
STALL_SECONDS = 30.0  # a client that stalls for longer, or stops within a packet, is disconnected
_SLOWEST_RATE = 64 << 10  # bytes a second: a payload has so much more time
_CHUNK_BYTES = 64 << 10  # of one call: memory is allocated for bytes received, not for bytes declared


class PacketSocket:
    """One client's connection. Methods raise OSError if it fails and PacketError if the client breaks the protocol."""

    def __init__(self, connection: socket.socket) -> None:
        self._connection = connection
        self._sending = threading.Lock()

    def greet(self) -> bool:
        """Exchange greetings, and wait for the first packet; return False if the client disconnected instead."""
        deadline = time.monotonic() + HANDSHAKE_SECONDS
        self._connection.settimeout(STALL_SECONDS)  # of each `sendall`
        self._connection.sendall(GREETING)
        late = f"the client sent no packet within {HANDSHAKE_SECONDS:g} s"
        if self._read(len(GREETING), deadline, late) != GREETING:
            raise PacketError("the client uses another protocol")
        if not self._await_bytes(deadline):
            raise PacketError(late)
        return bool(self._connection.recv(1, socket.MSG_PEEK))

    def next(self, on_payload: Callable[[int], None]) -> Packet | None:
        """Return the next packet, or None if the client disconnected between two packets.

        The client may be silent before a packet for any time. `on_payload` is called with the payload's size before
        memory is allocated for it.
        """
        self._await_bytes(None)
        if not self._connection.recv(1, socket.MSG_PEEK):
            return None
        deadline = time.monotonic() + STALL_SECONDS
        late = f"the client sent nothing for {STALL_SECONDS:g} s within a packet, or less than {_SLOWEST_RATE} bytes/s"
        header = read_header(self._read(HEADER_BYTES, deadline, late))
        key = check_key(self._read(header.key_bytes, deadline, late), header.kind)
        on_payload(header.payload_bytes)
        payload = self._read(header.payload_bytes, deadline + header.payload_bytes / _SLOWEST_RATE, late)
        return Packet(header.kind, header.number, key, header.timeout, payload)

    def _read(self, size: int, deadline: float, late: str) -> bytes:
        """Return exactly `size` bytes. Raises PacketError(late) after `deadline`, or if the client disconnects."""
        data, stalled = bytearray(), time.monotonic() + STALL_SECONDS
        while len(data) < size:
            if not self._await_bytes(min(deadline, stalled)):
                raise PacketError(late)
            chunk = self._connection.recv(min(size - len(data), _CHUNK_BYTES))
            if not chunk:
                raise PacketError("the client disconnected within a packet")
            data += chunk
            stalled = time.monotonic() + STALL_SECONDS
        return bytes(data)

    def _await_bytes(self, deadline: float | None) -> bool:
        """Wait until `recv` has something to return; False after `deadline` (None: no limit)."""
        poll = select.poll()
        poll.register(self._connection, select.POLLIN)
        return bool(poll.poll(None if deadline is None else max(deadline - time.monotonic(), 0.0) * 1000))

    def send(self, packet: Packet) -> None:
        """Send a packet, after those of other threads. The client has `STALL_SECONDS` to read each 64 KiB."""
        head = encode_head(packet)
        with self._sending:
            if len(packet.payload) < _CHUNK_BYTES:
                self._connection.sendall(head + packet.payload)
            else:  # without a copy of the payload
                self._connection.sendall(head)
                payload = memoryview(packet.payload)
                for first in range(0, len(payload), _CHUNK_BYTES):
                    self._connection.sendall(payload[first : first + _CHUNK_BYTES])

    def has_gone(self) -> bool:
        """Return whether the client closed its end, even if bytes that it sent before are still unread."""
        poll = select.poll()
        poll.register(self._connection, getattr(select, "POLLRDHUP", 0))
        return bool(poll.poll(0))

    def shut_down(self) -> None:
        """End both directions; wakes the threads that wait in `next` and `send`. Safe from any thread; idempotent."""
        with contextlib.suppress(OSError):
            self._connection.shutdown(socket.SHUT_RDWR)

    def close(self) -> None:
        """Release the socket, after the last use."""
        self._connection.close()
