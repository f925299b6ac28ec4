"""Serving of compact snapshots to actors that request them. Has its own thread, because differences take time."""

import queue
import threading
from collections.abc import Callable

from daedalus.learner.serving.compact_snapshot_cache import CompactSnapshotCache
from daedalus.protocol.codec import encode
from daedalus.protocol.messages import Refusal, SnapshotRequest
from daedalus.transport.interface import Request

_MAX_WAITING = 4096  # requests, of at most a kilobyte each
_CLOSE_SECONDS = 0.5  # for an answer in progress; a frozen reader must not delay the shutdown further


class CompactSnapshotServer:
    """Server of SnapshotRequests for compact snapshots, from `open` to `close`."""

    def __init__(
        self, learner_epoch: int, newest: Callable[[], bytes], on_answer: Callable[[SnapshotRequest, int], None]
    ) -> None:
        """Construct the server.

        Args:
          learner_epoch: epoch of this learner process.
          newest: function that returns the newest encoded snapshot.
          on_answer: called with the request and the number of bytes after each answer.
        """
        self._cache = CompactSnapshotCache(learner_epoch)
        self._newest, self._on_answer = newest, on_answer
        self._requests: queue.SimpleQueue[tuple[Request, SnapshotRequest] | None] = queue.SimpleQueue()
        self._thread = threading.Thread(target=self._work, name="compact snapshots", daemon=True)

    def open(self) -> None:
        """Start the thread."""
        self._thread.start()

    def offer(self, request: Request, message: SnapshotRequest) -> None:
        """Queue a request and its decoded payload, or refuse it if the queue is full. Does not block."""
        if self._requests.qsize() >= _MAX_WAITING:
            request.reply(encode(Refusal(code="not_ready", reason="too many requests for snapshots: retry later")))
        else:
            self._requests.put((request, message))

    def close(self) -> None:
        """Answer the waiting requests, and stop the thread."""
        self._requests.put(None)
        if self._thread.is_alive():
            self._thread.join(timeout=_CLOSE_SECONDS)

    def _work(self) -> None:
        while (waiting := self._requests.get()) is not None:
            request, message = waiting
            answer = self._cache.answer(message, self._newest())
            request.reply(answer)
            self._on_answer(message, len(answer))
