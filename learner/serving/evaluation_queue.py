"""Requests and reports of evaluators, held until the learner's thread has time for them. State with a lock."""

import threading
from collections import deque

from daedalus.protocol import keys
from daedalus.protocol.codec import ProtocolError, decode, encode
from daedalus.protocol.limits import EVALUATION_LIMITS
from daedalus.protocol.messages import EvaluationReport, EvaluationRequest, Refusal
from daedalus.transport.interface import Request

_MAX_WAITING = 64  # evaluators beyond that ask again later


class EvaluationQueue:
    """Serves the `evaluations` keys from `open` to `close`."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._waiting: deque[tuple[Request, EvaluationRequest | EvaluationReport]] = deque()
        self._ready = self._over = False

    def open(self) -> None:
        """Take requests from now on: there is a policy to evaluate."""
        self._ready = True

    def close(self, reason: str) -> None:
        """Refuse what waits and what comes."""
        with self._lock:
            self._over = True
        for request, _ in self.take():
            request.reply(encode(Refusal(code="finished", reason=reason)))

    def offer(self, request: Request) -> None:
        """Take in a message of an evaluator, or refuse it. Never waits."""
        try:
            message = decode(request.payload, EVALUATION_LIMITS)
        except ProtocolError as error:
            request.reply(encode(Refusal(code="malformed", reason=str(error))))
            return
        sender = keys.last_chunk(request.key)
        if not isinstance(message, EvaluationRequest | EvaluationReport) or message.evaluator != sender:
            request.reply(encode(Refusal(code="malformed", reason="evaluators ask and report under their own name")))
            return
        with self._lock:
            refused = self._over or not self._ready or len(self._waiting) >= _MAX_WAITING
            if not refused:
                self._waiting.append((request, message))
        if refused:
            code = "finished" if self._over else "not_ready"
            request.reply(encode(Refusal(code=code, reason="the learner has nothing to evaluate now")))

    def take(self) -> list[tuple[Request, EvaluationRequest | EvaluationReport]]:
        """Return what came since the last call; the caller replies to each."""
        with self._lock:
            taken = list(self._waiting)
            self._waiting.clear()
        return taken
