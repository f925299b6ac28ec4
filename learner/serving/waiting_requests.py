"""Messages of evaluators that wait for the learner's thread. State with locks."""

import threading
from typing import TypeVar

from daedalus.protocol import keys
from daedalus.protocol.codec import ProtocolError, decode, encode
from daedalus.protocol.limits import EVALUATION_LIMITS, Limits
from daedalus.protocol.messages import (
    EvaluationReport,
    EvaluationRequest,
    Refusal,
)
from daedalus.transport.interface import Request

Kind = TypeVar("Kind")


def read_request(payload: bytes, limits: Limits, *kinds: type[Kind]) -> Kind | Refusal:
    """Return the message of a query, or the Refusal of what is no message of these kinds."""
    try:
        message = decode(payload, limits)
    except ProtocolError as error:
        return Refusal(code="malformed", reason=str(error))
    if not isinstance(message, kinds):
        expected = " or ".join(kind.__name__ for kind in kinds)
        return Refusal(code="malformed", reason=f"expected {expected}, and not {type(message).__name__}")
    return message


_MAX_EVALUATIONS = 64  # requests, and as many reports

_M = TypeVar("_M")


class EvaluationQueue:
    """Bounded queue of messages on the `evaluations` keys. Accepts messages from `open` to `end`.

    It holds at most one request and one report of each evaluator: a newer message replaces the older one.
    """

    def __init__(self) -> None:
        self._lock = threading.Lock()
        # By evaluator, the oldest first.
        self._requests: dict[str, tuple[Request, EvaluationRequest]] = {}
        self._reports: dict[str, tuple[Request, EvaluationReport]] = {}
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
        for request, _ in [*self.take_requests(), *self.take_reports()]:
            request.reply(encode(ending))

    def offer(self, request: Request) -> None:
        """Queue a message of an evaluator, or refuse it. Does not block."""
        sender = keys.last_chunk(request.key)
        message = read_request(request.payload, EVALUATION_LIMITS, EvaluationRequest, EvaluationReport)
        if not isinstance(message, Refusal) and message.evaluator != sender:
            message = Refusal(code="malformed", reason=f"the message is not from evaluator {sender[:64]!r}")
        if isinstance(message, Refusal):
            request.reply(encode(message))
            return
        with self._lock:
            if self._ending is not None:
                refused, refusal = request, self._ending
            elif not self._ready:
                refused, refusal = request, _refusal("no evaluation is possible now")
            elif isinstance(message, EvaluationRequest):
                refused = _put(self._requests, sender, (request, message))
                refusal = _refusal("a newer request took its place")
            else:
                refused = _put(self._reports, sender, (request, message))
                refusal = _refusal("a newer report took its place")
        if refused is not None:
            refused.reply(encode(refusal))

    def take_requests(self) -> list[tuple[Request, EvaluationRequest]]:
        """Return the waiting requests for a policy. The caller replies to each."""
        with self._lock:
            taken, self._requests = self._requests, {}
        return list(taken.values())

    def take_reports(self) -> list[tuple[Request, EvaluationReport]]:
        """Return the waiting reports. The caller replies to each."""
        with self._lock:
            taken, self._reports = self._reports, {}
        return list(taken.values())


def _refusal(reason: str) -> Refusal:
    return Refusal(code="not_ready", reason=reason)


def _put(waiting: dict[str, tuple[Request, _M]], sender: str, entry: tuple[Request, _M]) -> Request | None:
    """Add a message of `sender`, and return the request that it displaces, if any.

    At capacity it displaces the oldest of the owner with the most, so that nobody fills the queue for the others.
    """
    displaced = sender if sender in waiting else None
    if displaced is None and len(waiting) >= _MAX_EVALUATIONS:
        displaced = keys.first_of_largest_owner(waiting)
    request = waiting.pop(displaced)[0] if displaced is not None else None
    waiting[sender] = entry
    return request
