"""Answers those whose links do not carry every snapshot whole, on a thread of its own: differences take time."""

import threading
from collections.abc import Callable

from daedalus.learner.serving.compact_snapshot_cache import CompactSnapshotCache
from daedalus.learner.serving.request_queue import RequestQueue
from daedalus.protocol.codec import ProtocolError, decode, encode
from daedalus.protocol.limits import SNAPSHOT_REQUEST_LIMITS
from daedalus.protocol.messages import Refusal, SnapshotRequest
from daedalus.transport.interface import Request

_WAITING_BYTES, _WAITING = 256 << 10, 4096
_LEAVING_SECONDS = 0.5  # for an answer under way; its reader may be frozen, and others wait to leave as well


class CompactSnapshotServer:
    """Takes SnapshotRequests from `open` to `close`."""

    def __init__(self, learner_epoch: int, newest: Callable[[], bytes], on_answer: Callable[[str, int], None]) -> None:
        """`newest` gives the encoded snapshot; `on_answer` is told who was sent how many bytes."""
        self._cache = CompactSnapshotCache(learner_epoch)
        self._newest, self._on_answer = newest, on_answer
        self._requests = RequestQueue(_WAITING_BYTES, _WAITING)
        self._thread = threading.Thread(target=self._work, name="slow links", daemon=True)

    def open(self) -> None:
        """Starts to answer."""
        self._thread.start()

    def offer(self, request: Request) -> None:
        """Takes a request; never waits."""
        if not self._requests.offer(request):
            request.reply(encode(Refusal(code="not_ready", reason="too many ask at once")))

    def close(self) -> None:
        """Answers what waits, and no more."""
        self._requests.close()
        if self._thread.is_alive():
            self._thread.join(timeout=_LEAVING_SECONDS)

    def _work(self) -> None:
        while (request := self._requests.take()) is not None:
            try:
                message = decode(request.payload, SNAPSHOT_REQUEST_LIMITS)
            except ProtocolError as error:
                request.reply(encode(Refusal(code="malformed", reason=str(error))))
                continue
            if not isinstance(message, SnapshotRequest):
                request.reply(encode(Refusal(code="malformed", reason="only those who want a snapshot belong here")))
                continue
            answer = self._cache.answer(message, self._newest())
            request.reply(answer)
            self._on_answer(message.actor, len(answer))
