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
    """Bounded queue of messages on the `evaluations` keys. Accepts messages from `open` to `end`."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._waiting: deque[tuple[Request, EvaluationRequest | EvaluationReport]] = deque()
        self._ready = False
        self._ending: Refusal | None = None  # of all messages after the end

    def open(self) -> None:
        """Accept messages from now on. Called when there is a policy to evaluate."""
        self._ready = True

    def end(self, reason: str, *, finished: bool) -> None:
        """Refuse all waiting and all later messages, with `reason`."""
        ending = Refusal(code="finished" if finished else "not_ready", reason=reason)
        with self._lock:
            self._ending = ending
        for request, _ in self.take():
            request.reply(encode(ending))

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
            refusal = self._ending
            if refusal is None and (not self._ready or len(self._waiting) >= _MAX_WAITING):
                refusal = Refusal(code="not_ready", reason="no evaluation is possible now")
            if refusal is None:
                self._waiting.append((request, message))
        if refusal is not None:
            request.reply(encode(refusal))

    def take(self) -> list[tuple[Request, EvaluationRequest | EvaluationReport]]:
        """Return the messages since the last call. The caller replies to each request."""
        with self._lock:
            taken = list(self._waiting)
            self._waiting.clear()
        return taken
