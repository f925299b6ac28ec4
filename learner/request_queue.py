"""Requests that wait to be judged, bounded by the bytes they hold. State with a lock, no threads of its own."""

import queue
import threading

from protocol.transport import Request


class RequestQueue:
    """First in, first out. `offer` never waits, `take` does."""

    def __init__(self, max_bytes: int) -> None:
        self._max_bytes = max_bytes
        self._bytes = 0
        self._lock = threading.Lock()
        self._requests: queue.SimpleQueue[Request | None] = queue.SimpleQueue()

    def offer(self, request: Request) -> bool:
        """Takes a request unless that would exceed the bound; an empty queue takes any."""
        with self._lock:
            if self._bytes and self._bytes + request.size > self._max_bytes:
                return False
            self._bytes += request.size
        self._requests.put(request)
        return True

    def take(self) -> Request | None:
        """Waits for the oldest request; None once the queue was closed and is empty."""
        request = self._requests.get()
        if request is not None:
            with self._lock:
                self._bytes -= request.size
        return request

    @property
    def bytes(self) -> int:
        """What the requests that wait hold."""
        return self._bytes

    def close(self) -> None:
        """Lets `take` return None after what is queued already."""
        self._requests.put(None)
