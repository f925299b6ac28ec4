"""Orders to the learner's thread, of operators and of a newer learner. State; other threads give them."""

import threading
from collections.abc import Callable

from daedalus.protocol.codec import encode
from daedalus.protocol.messages import Acknowledgement, Order, Refusal
from daedalus.transport.interface import Request

_ANSWER_SECONDS = 3.0  # a gateway waits 5 s for its answer
_MOST_WAITING = 16  # requests whose answers wait
_LATER = "not saved yet: the events of the run say when the checkpoint is saved"


class Orders:
    """The orders that were not carried out yet.

    A checkpoint is written beside training. The answer waits until it is saved, for a few seconds at most.
    """

    def __init__(self, stop: threading.Event) -> None:
        """`stop` ends the run."""
        self._stop, self._lock = stop, threading.Lock()
        self._wanted = False
        self._waiting: list[Request] = []
        self.stopped = False  # whether an operator stopped the run
        self.superseded_by: int | None = None  # epoch of a newer learner of the run, for which this one steps down

    def give(self, order: Order, request: Request) -> None:
        """Note an order, which is answered now or when it is carried out. Does not block."""
        if order == "stop":
            self.stopped = True
            self._stop.set()
            request.reply(encode(Acknowledgement(verdict="accepted")))
            return
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
        self._stop.set()

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


def _answer_later(request: Request) -> None:
    request.reply(encode(Acknowledgement(verdict="accepted", reason=_LATER)))
