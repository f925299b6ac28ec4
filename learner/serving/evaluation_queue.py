"""Requests and reports of evaluators that wait for the learner's thread. State with a lock."""

import threading
from collections import deque

from daedalus.protocol import keys
from daedalus.protocol.codec import ProtocolError, decode, encode
from daedalus.protocol.limits import EVALUATION_LIMITS
from daedalus.protocol.messages import EvaluationReport, EvaluationRequest, Refusal
from daedalus.transport.interface import Request

_MAX_WAITING = 64  # messages; further messages are answered not_ready


class EvaluationQueue:
    """Bounded queue of messages on the `evaluations` keys. Accepts messages from `open` to `close`."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._waiting: deque[tuple[Request, EvaluationRequest | EvaluationReport]] = deque()
        self._ready = self._closed = False

    def open(self) -> None:
        """Accept messages from now on. Called when there is a policy to evaluate."""
        self._ready = True

    def close(self, reason: str) -> None:
        """Refuse all waiting and all later messages, with `reason`."""
        with self._lock:
            self._closed = True
        for request, _ in self.take():
            request.reply(encode(Refusal(code="finished", reason=reason)))

    def offer(self, request: Request) -> None:
        """Queue a message of an evaluator, or refuse it. Does not block."""
        try:
            message = decode(request.payload, EVALUATION_LIMITS)
        except ProtocolError as error:
            request.reply(encode(Refusal(code="malformed", reason=str(error))))
            return
        sender = keys.last_chunk(request.key)
        if not isinstance(message, EvaluationRequest | EvaluationReport) or message.evaluator != sender:
            reason = f"expected an EvaluationRequest or EvaluationReport of evaluator {sender!r}"
            request.reply(encode(Refusal(code="malformed", reason=reason)))
            return
        with self._lock:
            refused = self._closed or not self._ready or len(self._waiting) >= _MAX_WAITING
            if not refused:
                self._waiting.append((request, message))
        if refused:
            code = "finished" if self._closed else "not_ready"
            request.reply(encode(Refusal(code=code, reason="no evaluation is possible now")))

    def take(self) -> list[tuple[Request, EvaluationRequest | EvaluationReport]]:
        """Return the messages since the last call. The caller replies to each request."""
        with self._lock:
            taken = list(self._waiting)
            self._waiting.clear()
        return taken
