"""Requests that wait to be judged, bounded by bytes and by number. State with a lock, no threads of its own."""

import queue
import threading

from daedalus.transport.interface import Request


class RequestQueue:
    """First in, first out. `offer` never waits, `take` does."""

    def __init__(self, max_bytes: int, max_requests: int) -> None:
        self._max_bytes, self._max_requests = max_bytes, max_requests
        self._bytes = self._number = 0
        self._lock = threading.Lock()
        self._requests: queue.SimpleQueue[Request | None] = queue.SimpleQueue()

    def offer(self, request: Request) -> bool:
        """Takes a request unless that would exceed a bound; an empty queue takes any."""
        with self._lock:
            full = self._number >= self._max_requests or self._bytes + request.size > self._max_bytes
            if self._number and full:
                return False
            self._bytes += request.size
            self._number += 1
        self._requests.put(request)
        return True

    def take(self) -> Request | None:
        """Waits for the oldest request; None once the queue was closed and is empty."""
        request = self._requests.get()
        if request is not None:
            with self._lock:
                self._bytes -= request.size
                self._number -= 1
        return request

    @property
    def bytes(self) -> int:
        """What the requests that wait hold."""
        return self._bytes

    def close(self) -> None:
        """Lets `take` return None after what is queued already."""
        self._requests.put(None)
