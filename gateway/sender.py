"""Sends the queries of all clients on a thread of its own: Zenoh makes a sender wait while the link is congested."""

import contextlib
import queue
import threading
from collections.abc import Callable
from typing import NamedTuple

from daedalus.transport.interface import OnAnswer, Transport, TransportError

_MAX_QUERIES = 1 << 17  # that wait for the thread: the windows of 2,048 clients, with 64 rollouts each
_POLL_SECONDS = 0.2  # how soon the thread notices `close` if the queue was full


class _Query(NamedTuple):
    """Arguments of one `query_async`."""

    key: str
    payload: bytes
    timeout: float
    on_answer: OnAnswer


class Sender:
    """A QuerySender: a queue of queries, which the thread sends in the order of the calls."""

    def __init__(self, transport: Transport, on_failure: Callable[[Exception], None]) -> None:
        """Construct the sender.

        Args:
          transport: the network; the caller closes it, after the sender.
          on_failure: called on the thread with an error of ours, which ends it.
        """
        self._transport, self._on_failure = transport, on_failure
        self._queue: queue.Queue[_Query | None] = queue.Queue(_MAX_QUERIES)
        self._closed = threading.Event()
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

    def query_async(self, key: str, payload: bytes, *, timeout: float, on_answer: OnAnswer) -> None:
        """See QuerySender. `timeout` begins when the thread sends the query."""
        if self._closed.is_set():
            raise TransportError("the gateway stops")
        try:
            self._queue.put_nowait(_Query(key, payload, timeout, on_answer))
        except queue.Full:
            raise TransportError(f"{_MAX_QUERIES:,} queries wait for the link already: try again later") from None

    def _run(self) -> None:
        try:
            while not (self._closed.is_set() and self._queue.empty()):
                with contextlib.suppress(queue.Empty):
                    self._send(self._queue.get(timeout=_POLL_SECONDS))
        except Exception as error:  # broad: any error of ours ends the gateway
            self._on_failure(error)

    def _send(self, query: _Query | None) -> None:
        if query is None:
            return
        try:
            self._transport.query_async(query.key, query.payload, timeout=query.timeout, on_answer=query.on_answer)
        except TransportError:
            query.on_answer(None)
