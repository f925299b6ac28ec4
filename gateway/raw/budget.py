"""Limits on the open queries of one client, by number and bytes, and of all together. State with a lock, no threads."""

import threading
from collections.abc import Callable

_POLL_SECONDS = 0.2  # between checks of whether the client has disconnected
_MAX_QUERIES = 64
_MAX_BYTES = 64 << 20
# Each open query has a thread. A client always has a few, and the rest is for those that come first: with 64 clients
# (clients.py), there are at most 512 threads, and a client that takes all it can get leaves the others their own.
_OWN_QUERIES = 4
_SHARED_QUERIES = 256


class QueryPool:
    """The open queries of all clients, beyond those that each client always may have."""

    def __init__(self) -> None:
        self.changed = threading.Condition()  # guards the pool and its budgets
        self.taken = 0

    @property
    def has_room(self) -> bool:
        """Whether one more query may be open. With the lock held."""
        return self.taken < _SHARED_QUERIES


class QueryBudget:
    """Bounds the open queries of one client.

    The thread that reads the client's packets waits here, so TCP's flow control then makes the client wait.
    """

    def __init__(self, pool: QueryPool) -> None:
        self._pool, self._changed = pool, pool.changed
        self._queries = self._bytes = 0
        self._closed = False

    def take(self, size: int, has_gone: Callable[[], bool]) -> bool:
        """Wait until a query of `size` bytes fits; a query that is alone always fits.

        Returns False if the budget was closed or `has_gone` returned True.
        """
        with self._changed:
            while not self._closed and not self._has_room(size):
                self._changed.wait(_POLL_SECONDS)
                if has_gone():
                    return False
            self._pool.taken += self._queries >= _OWN_QUERIES
            self._queries += 1
            self._bytes += size
            return not self._closed

    def _has_room(self, size: int) -> bool:
        if not self._queries:
            return True
        fits = self._queries < _MAX_QUERIES and self._bytes + size <= _MAX_BYTES
        return fits and (self._queries < _OWN_QUERIES or self._pool.has_room)

    def give_back(self, size: int) -> None:
        """Release a query that ended, and its bytes."""
        with self._changed:
            self._queries -= 1
            self._bytes -= size
            self._pool.taken -= self._queries >= _OWN_QUERIES
            self._changed.notify_all()

    def close(self) -> None:
        """End all waits; every later `take` returns False."""
        with self._changed:
            self._closed = True
            self._changed.notify_all()
