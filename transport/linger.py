"""Connections that are closed at once, also if the other end does not answer any more.

Zenoh sets the option SO_LINGER of each TCP connection to 10 s. To close a connection whose link is dead then blocks one
of the two threads on which Zenoh receives from all peers, for 10 s: a router that loses 4 actors at the same moment
would forward nothing for 20 s. Without the option the operating system closes such a connection in the background.
"""

import contextlib
import functools
import os
import socket
import struct
import threading
import time
from pathlib import Path
from typing import Any

_DESCRIPTORS = Path("/dev/fd")  # of this process
_LINGER = struct.Struct("ii")  # whether close() waits, and for how many seconds
_ZENOHS_LINGER = _LINGER.pack(1, 10)
_PAUSE_SECONDS = 0.5  # so that many connections that are opened at the same time are found together


class LingerRemoval:
    """Removal of the option from every connection of this process. Has its own thread, which never ends."""

    def __init__(self) -> None:
        self._changed = threading.Event()
        threading.Thread(target=self._remove_repeatedly, name="linger removal", daemon=True).start()

    def connections_changed(self, *_: Any) -> None:
        """Note that a connection was opened. From any thread."""
        self._changed.set()

    def _remove_repeatedly(self) -> None:
        while self._changed.wait():
            time.sleep(_PAUSE_SECONDS)
            self._changed.clear()
            remove_linger()


@functools.cache
def linger_removal() -> LingerRemoval:
    """Return the one of this process."""
    return LingerRemoval()


def remove_linger() -> None:
    """Remove the option that Zenoh sets from all connections of this process."""
    for entry in os.listdir(_DESCRIPTORS) if _DESCRIPTORS.is_dir() else ():
        with contextlib.suppress(OSError):  # not a socket, or closed meanwhile
            _remove_from(int(entry))


def _remove_from(descriptor: int) -> None:
    # The family has no effect on the option. `detach` leaves the descriptor open: it is Zenoh's.
    connection = socket.socket(socket.AF_INET, socket.SOCK_STREAM, fileno=descriptor)
    try:
        if connection.getsockopt(socket.SOL_SOCKET, socket.SO_LINGER, _LINGER.size) == _ZENOHS_LINGER:
            connection.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, _LINGER.pack(0, 0))
    finally:
        connection.detach()
