"""Queue of undecoded requests, bounded by bytes and by number. State with a lock, no threads of its own."""

import queue
import threading
from typing import Any

from daedalus.transport.interface import Request

_WAKE = object()


class RequestQueue:
    """First-in, first-out queue of requests. `offer` does not block, `take` does."""

    def __init__(self, max_bytes: int, max_requests: int) -> None:
        self._max_bytes, self._max_requests = max_bytes, max_requests
        self._bytes = self._number = 0
        self._lock = threading.Lock()
        self._requests: queue.SimpleQueue[Any] = queue.SimpleQueue()

    def offer(self, request: Request) -> bool:
        """Queue a request and return True, or return False if a bound would be exceeded.

        An empty queue accepts a request of any size.
        """
        with self._lock:
            full = self._number >= self._max_requests or self._bytes + request.size > self._max_bytes
            if self._number and full:
                return False
            self._bytes += request.size
            self._number += 1
        self._requests.put(request)
        return True

    def take(self, timeout: float | None = None) -> Request | None:
        """Wait for the oldest request and return it, or None if the queue is closed and empty.

        Raises queue.Empty if no request comes within `timeout` seconds, or after `wake`.
        """
        request = self._requests.get(timeout=timeout)
        if request is _WAKE:
            raise queue.Empty
        if request is not None:
            with self._lock:
                self._bytes -= request.size
                self._number -= 1
        return request

    def wake(self) -> None:
        """Let `take` raise queue.Empty once."""
        self._requests.put(_WAKE)

    @property
    def bytes(self) -> int:
        """Total size of the waiting requests, in bytes."""
        return self._bytes

    def close(self) -> None:
        """Close the queue: `take` returns the waiting requests, then None."""
        self._requests.put(None)
