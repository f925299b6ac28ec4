"""Orders of operators to this learner: who may give which, and what waits for the learner's thread. State with locks.

Whether a sender may give orders at all, and under which name, is checked by the routers (transport/access_control.py).
"""

import threading
from collections import deque
from collections.abc import Callable

from daedalus.learner.serving.events import DRAINED_BY, ORDERED_BY, dated
from daedalus.learner.serving.run_context import RunContext
from daedalus.learner.serving.waiting_requests import read_request
from daedalus.protocol import keys
from daedalus.protocol.codec import encode
from daedalus.protocol.limits import STATUS_REQUEST_LIMITS
from daedalus.protocol.messages import Acknowledgement, OrderRequest, Refusal
from daedalus.protocol.texts import bounded_text
from daedalus.transport.interface import Request

_ANSWER_SECONDS = 3.0  # whoever gives an order waits 5 s for its answer
_MOST_WAITING = 16  # requests whose answers wait
_MOST_NUMBERS = 1024  # of the newest orders
_LATER = "not saved yet: the events of the run say when the checkpoint is saved"


class Orders:
    """The orders to one learner process, and those among them that were not carried out yet.

    A checkpoint is written beside training. The answer waits until it is saved, for a few seconds at most; so does the
    answer to a stop, which ends with a checkpoint.

    Attributes:
      stopped_by: the operator who has stopped the run; empty if none has.
      superseded_by: epoch of a newer learner of the run, for which this one steps down.
      last: the newest order, its author and time, for the status.
    """

    def __init__(self, context: RunContext) -> None:
        """Construct it. A stop sets the stop event of the run."""
        self._context = context
        self._lock = threading.Lock()  # guards what is below
        self._numbers: deque[int] = deque(maxlen=_MOST_NUMBERS)
        self._wanted = False
        self._waiting: list[Request] = []  # for the next checkpoint
        self.stopped_by, self.last = "", ""
        self.superseded_by: int | None = None

    def receive(self, request: Request) -> None:
        """Carry out or note the order in a query, or refuse it. Does not block."""
        message, operator = (
            read_request(request.payload, STATUS_REQUEST_LIMITS, OrderRequest),
            keys.last_chunk(request.key),
        )
        if not (keys.is_name(operator) or operator == keys.NO_OPERATOR):
            message = Refusal(code="malformed", reason="the key of an order names one operator")
        refusal = message if isinstance(message, Refusal) else self._obey(message, operator, request)
        if refusal is not None:
            request.reply(encode(refusal))

    def _obey(self, message: OrderRequest, operator: str, request: Request) -> Refusal | None:
        """Carry out or note an order; return the Refusal of one that is not for this process, or that came before."""
        author, context = message.author(operator), self._context
        refusal = self._misdirected(message)
        if refusal is None and message.order == "drain":
            with context.lock:
                refusal = context.fleet.drain(message.actor, author)
        if refusal is not None:
            text = f"refused to {_infinitive(message)} as ordered by {author}: {refusal.reason}"
            context.events.add("refused", text, cause="order")
            return refusal
        self.last = bounded_text(dated(f"{_infinitive(message)}, by {author}"))
        if message.order == "drain":
            text = f"{DRAINED_BY}{author}: it leaves after its current rollout"
            context.events.add("left", text, actor=message.actor)
            request.reply(encode(Acknowledgement(verdict="accepted")))
        elif message.order == "checkpoint":
            context.events.add("checkpoint", f"{ORDERED_BY}{author}")
            self._await_checkpoint(request)
        else:
            self.stopped_by = author
            self._await_checkpoint(request)
            context.stop.set()
        return None

    def _misdirected(self, message: OrderRequest) -> Refusal | None:
        """Return the Refusal of an order to another process, or of one that came before."""
        run, epoch = self._context.name, self._context.learner_epoch
        if message.run != run:
            reason = f"the order is for run {message.run[:64]!r}, and this is run {run!r}"
        elif message.learner_epoch != epoch:
            reason = (
                f"the order is for another learner process of this run (epoch {message.learner_epoch:x}, and this is "
                f"{epoch:x}): give the order again"
            )
        else:
            with self._lock:
                if message.number not in self._numbers:
                    self._numbers.append(message.number)
                    return None
            reason = "this order came before: an order is carried out once"
        return Refusal(code="mismatch", reason=bounded_text(reason))

    def _await_checkpoint(self, request: Request) -> None:
        with self._lock:
            self._wanted = True
            waits = len(self._waiting) < _MOST_WAITING
            if waits:
                self._waiting.append(request)
        if not waits:
            _answer_later(request)
            return
        timer = threading.Timer(_ANSWER_SECONDS, _answer_later, [request])  # no effect if it is answered by then
        timer.daemon = True
        timer.start()

    def step_down(self, newer: int) -> None:
        """Stop the run here: a learner of it with a newer epoch answers."""
        self.superseded_by = newer
        self._context.stop.set()

    @property
    def stop_cause(self) -> str:
        """What has stopped the run."""
        if self.superseded_by is not None:
            return "a newer learner of this run"
        return self.stopped_by or "a signal, or the program that started the learner"

    @property
    def checkpoint_wanted(self) -> bool:
        """Whether a checkpoint was ordered that `take_checkpoint` has not returned."""
        return self._wanted

    def take_checkpoint(self) -> Callable[[bool, str], None]:
        """Take the orders of a checkpoint. Return what answers them: with whether it is saved, and what came of it."""
        with self._lock:
            self._wanted, waiting, self._waiting = False, self._waiting, []

        def answer(is_saved: bool, result: str) -> None:
            accepted = Acknowledgement(verdict="accepted", reason=result)
            message = encode(accepted if is_saved else Refusal(code="failed", reason=result))
            for request in waiting:
                request.reply(message)

        return answer


def _infinitive(message: OrderRequest) -> str:
    match message.order:
        case "stop":
            return "stop the run"
        case "checkpoint":
            return "save a checkpoint"
        case "drain":
            return f"drain actor {bounded_text(message.actor, 64)}"


def _answer_later(request: Request) -> None:
    request.reply(encode(Acknowledgement(verdict="accepted", reason=_LATER)))
