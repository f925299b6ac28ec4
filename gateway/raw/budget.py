"""Limit on the open queries of a client, by number and bytes. State with a lock, no threads."""

import threading
from collections.abc import Callable

_HEARTBEAT_SECONDS = 0.2  # between checks of whether the client has disconnected
_MAX_QUERIES = 64
_MAX_BYTES = 64 << 20


class QueryBudget:
    """Bounds the open queries of one client.

    The thread that reads the client's packets waits here, so TCP's flow control then makes the client wait.
    """

    def __init__(self) -> None:
        self._changed = threading.Condition()
        self._queries = self._bytes = 0
        self._closed = False

    def take(self, size: int, has_gone: Callable[[], bool]) -> bool:
        """Wait until a query of `size` bytes fits; a query that is alone always fits.

        Returns False if the budget was closed or `has_gone` returned True.
        """
        with self._changed:
            while not self._closed and not self._has_room(size):
                self._changed.wait(_HEARTBEAT_SECONDS)
                if has_gone():
                    return False
            self._queries += 1
            self._bytes += size
            return not self._closed

    def _has_room(self, size: int) -> bool:
        fits = self._queries < _MAX_QUERIES and self._bytes + size <= _MAX_BYTES
        return fits or not self._queries

    def give_back(self, size: int) -> None:
        """Release the bytes of a query that ended."""
        with self._changed:
            self._queries -= 1
            self._bytes -= size
            self._changed.notify_all()

    def close(self) -> None:
        """End all waits; every later `take` returns False."""
        with self._changed:
            self._closed = True
            self._changed.notify_all()
