"""Queue of undecoded requests, bounded by bytes, number and waiting time. State with a lock, no threads of its own."""

import queue
import threading
import time
from collections import deque

from daedalus.transport.interface import Request

# Senders take a request for lost that waits 30 s, and send it again.
_OLDEST_SECONDS = 10.0  # while a request has waited longer, others are refused
LATE_SECONDS = 15.0  # after which a request needs an answer; an accepted rollout may wait for its batch after that


class RequestQueue:
    """First-in, first-out queue of requests. `offer` does not block, `take` does."""

    def __init__(self, max_bytes: int, max_requests: int) -> None:
        self.max_requests = max_requests
        self._max_bytes = max_bytes
        self._bytes = 0
        self._requests: deque[tuple[float, Request]] = deque()  # with the time of arrival, on the monotonic clock
        self._is_closed = self._is_woken = False
        self._changed = threading.Condition()

    def offer(self, request: Request) -> bool:
        """Queue a request and return True, or return False if a bound would be exceeded, or the oldest waits too long.

        An empty queue accepts a request of any size.
        """
        now = time.monotonic()
        with self._changed:
            full = len(self._requests) >= self.max_requests or self._bytes + request.size > self._max_bytes
            if self._requests and (full or now - self._requests[0][0] > _OLDEST_SECONDS):
                return False
            self._bytes += request.size
            self._requests.append((now, request))
            self._changed.notify()
        return True

    def take(self, timeout: float | None = None) -> tuple[float, Request] | None:
        """Wait for the oldest request; return when it arrived, and it, or None if the queue is closed and empty.

        Raises queue.Empty if no request comes within `timeout` seconds, or after `wake`.
        """
        with self._changed:
            self._changed.wait_for(lambda: self._requests or self._is_closed or self._is_woken, timeout)
            if self._is_woken or not (self._requests or self._is_closed):
                self._is_woken = False
                raise queue.Empty
            if not self._requests:
                return None
            arrived, request = self._requests.popleft()
            self._bytes -= request.size
            return arrived, request

    def take_late(self) -> list[Request]:
        """Take the requests that have waited so long that they need an answer now."""
        late, now = [], time.monotonic()
        with self._changed:
            while self._requests and now - self._requests[0][0] > LATE_SECONDS:
                _, request = self._requests.popleft()
                self._bytes -= request.size
                late.append(request)
        return late

    def wake(self) -> None:
        """Let `take` raise queue.Empty once."""
        with self._changed:
            self._is_woken = True
            self._changed.notify()

    @property
    def bytes(self) -> int:
        """Total size of the waiting requests, in bytes."""
        return self._bytes

    def close(self) -> None:
        """Close the queue: `take` returns the waiting requests, then None."""
        with self._changed:
            self._is_closed = True
            self._changed.notify()
