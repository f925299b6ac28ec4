"""Sends the queries of all clients on a thread of its own: Zenoh makes a sender wait while the link is congested."""

import contextlib
import queue
import threading
import time
from collections.abc import Callable

from daedalus.actor.session.conversation import Query
from daedalus.transport.interface import Transport, TransportError

_MAX_QUERIES = 1 << 17  # that wait for the thread: the windows of 2,048 clients, with 64 rollouts each
_POLL_SECONDS = 0.2  # how soon the thread notices `close` if the queue was full


class Sender:
    """A queue of queries, which the thread sends in the order of the calls.

    Attributes:
      lock: is held while an answer is received, on the transport's threads. Hold it to change what answers change.
    """

    def __init__(self, transport: Transport, on_failure: Callable[[Exception], None]) -> None:
        """Construct the sender.

        Args:
          transport: the network; the caller closes it, after the sender.
          on_failure: called on the thread with an error of ours, which ends it.
        """
        self._transport, self._on_failure = transport, on_failure
        self._queue: queue.Queue[Query | None] = queue.Queue(_MAX_QUERIES)
        self._closed = threading.Event()
        self.lock = threading.Lock()
        self._thread = threading.Thread(target=self._run, name="sender", daemon=True)

    def open(self) -> None:
        """Begin to send."""
        self._thread.start()

    def close(self, timeout: float) -> None:
        """Send what waits, for at most `timeout` seconds, and refuse further queries. Idempotent."""
        self._closed.set()
        with contextlib.suppress(queue.Full):
            self._queue.put_nowait(None)  # wakes the thread
        if self._thread.is_alive():
            self._thread.join(timeout)

    def send(self, query: Query) -> None:
        """Send a query, soon. Without room for it, or after `close`, there is no answer."""
        try:
            if not self._closed.is_set():
                self._queue.put_nowait(query)
                return
        except queue.Full:
            pass
        self._answer(query, None)

    def _run(self) -> None:
        try:
            while not (self._closed.is_set() and self._queue.empty()):
                with contextlib.suppress(queue.Empty):
                    self._send(self._queue.get(timeout=_POLL_SECONDS))
        except Exception as error:  # broad: any error of ours ends the gateway
            self._on_failure(error)

    def _send(self, query: Query | None) -> None:
        if query is None:
            return
        try:
            self._transport.query_async(
                query.key, query.payload, timeout=query.timeout, on_answer=lambda data: self._answer(query, data)
            )
        except TransportError:
            self._answer(query, None)

    def _answer(self, query: Query, data: bytes | None) -> None:
        with self.lock:
            query.on_answer(data, time.monotonic())
