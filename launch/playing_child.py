"""What the processes have in common that play for a gateway's page: what they are sent, and their standard output."""

import json
import os
import queue
import sys
import threading
from typing import Any, BinaryIO

from daedalus.gateway.watching.playing_process import LENGTH
from daedalus.protocol.codec import ProtocolError, decode
from daedalus.protocol.limits import LEARNER_LIMITS
from daedalus.protocol.messages import Message, Program, Snapshot, Welcome

NICENESS = 19
_READ_BYTES = 1 << 20
_MOST_ORDERS = 64  # that wait


class PlayingInput:
    """What the gateway sends, read on a thread of its own.

    Attributes:
      newest: the newest snapshot.
      orders: maps that came as JSON. A snapshot that came before an order is `newest` when the order is taken.
    """

    def __init__(self, descriptor: int, stop: threading.Event) -> None:
        """`stop` is set when the gateway closes the input."""
        self._descriptor, self._stop = descriptor, stop  # not a buffered stream, whose lock the thread would hold
        self.newest: Snapshot | None = None
        self.orders: queue.Queue[dict[str, Any]] = queue.Queue(_MOST_ORDERS)

    def begin(self) -> tuple[Welcome, Program]:
        """Return the first two messages, and read the others from then on. Raises EOFError or ProtocolError."""
        welcome, program = self._read(), self._read()
        if not isinstance(welcome, Welcome) or not isinstance(program, Program):
            raise ProtocolError("the first messages are no Welcome and Program")
        self._keep()
        threading.Thread(target=self._follow, name="input", daemon=True).start()
        return welcome, program

    def _follow(self) -> None:
        try:
            while True:
                self._keep()
        except EOFError:
            self._stop.set()

    def _keep(self) -> None:
        message = self._read()
        if isinstance(message, Snapshot):
            self.newest = message
        elif isinstance(message, dict):
            self.orders.put(message)

    def _read(self) -> Message | dict[str, Any]:
        (length,) = LENGTH.unpack(self._exactly(LENGTH.size))
        if length > LEARNER_LIMITS.message_bytes:
            raise ProtocolError(f"a message of {length} bytes")
        data = self._exactly(length)
        return json.loads(data) if data.startswith(b"{") else decode(data, LEARNER_LIMITS)

    def _exactly(self, length: int) -> bytes:
        data = bytearray()
        while len(data) < length:
            part = os.read(self._descriptor, min(length - len(data), _READ_BYTES))
            if not part:
                raise EOFError
            data += part
        return bytes(data)


def write_frame(stream: BinaryIO, data: bytes) -> None:
    """Write a frame now."""
    stream.write(LENGTH.pack(len(data)) + data)
    stream.flush()


def reserved_stdout() -> BinaryIO:
    """Return standard output for frames alone: what an environment prints goes to standard error."""
    reserved = os.fdopen(os.dup(sys.stdout.fileno()), "wb")
    os.dup2(sys.stderr.fileno(), sys.stdout.fileno())
    return reserved
