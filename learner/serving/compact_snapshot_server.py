"""Serving of compact snapshots to actors on slow links. Has its own thread, because differences take time."""

import threading
from collections.abc import Callable

from daedalus.learner.serving.compact_snapshot_cache import CompactSnapshotCache
from daedalus.learner.serving.request_queue import RequestQueue
from daedalus.protocol.codec import ProtocolError, decode, encode
from daedalus.protocol.limits import SNAPSHOT_REQUEST_LIMITS
from daedalus.protocol.messages import Refusal, SnapshotRequest
from daedalus.transport.interface import Request

_MAX_WAITING_BYTES, _MAX_WAITING = 256 << 10, 4096
_CLOSE_SECONDS = 0.5  # for an answer in progress; a frozen reader must not delay the shutdown further


class CompactSnapshotServer:
    """Server of SnapshotRequests, from `open` to `close`."""

    def __init__(self, learner_epoch: int, newest: Callable[[], bytes], on_answer: Callable[[str, int], None]) -> None:
        """Construct the server.

        Args:
          learner_epoch: epoch of this learner process.
          newest: function that returns the newest encoded snapshot.
          on_answer: called with the name of the actor and the number of bytes after each answer.
        """
        self._cache = CompactSnapshotCache(learner_epoch)
        self._newest, self._on_answer = newest, on_answer
        self._requests = RequestQueue(_MAX_WAITING_BYTES, _MAX_WAITING)
        self._thread = threading.Thread(target=self._work, name="compact snapshots", daemon=True)

    def open(self) -> None:
        """Start the thread."""
        self._thread.start()

    def offer(self, request: Request) -> None:
        """Queue a request, or refuse it if the queue is full. Does not block."""
        if not self._requests.offer(request):
            request.reply(encode(Refusal(code="not_ready", reason="too many requests for snapshots: retry later")))

    def close(self) -> None:
        """Answer the waiting requests, and stop the thread."""
        self._requests.close()
        if self._thread.is_alive():
            self._thread.join(timeout=_CLOSE_SECONDS)

    def _work(self) -> None:
        while (request := self._requests.take()) is not None:
            try:
                message = decode(request.payload, SNAPSHOT_REQUEST_LIMITS)
            except ProtocolError as error:
                request.reply(encode(Refusal(code="malformed", reason=str(error))))
                continue
            if not isinstance(message, SnapshotRequest):
                request.reply(encode(Refusal(code="malformed", reason="expected a SnapshotRequest")))
                continue
            answer = self._cache.answer(message, self._newest())
            request.reply(answer)
            self._on_answer(message.actor, len(answer))
