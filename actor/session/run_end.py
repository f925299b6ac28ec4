"""The end of an actor's session: a local stop, or the learner's message that it ends. No threads."""

import threading
from collections.abc import Callable

from daedalus.protocol import keys
from daedalus.protocol.codec import ProtocolError, decode
from daedalus.protocol.limits import ACKNOWLEDGEMENT_LIMITS
from daedalus.protocol.messages import RunEnded, starts_of
from daedalus.protocol.texts import MAX_ANSWER_TEXT, bounded_text
from daedalus.transport.interface import Inbox, Transport

DRAINED = "an operator drained this actor: it leaves the run"


class RunOverError(Exception):
    """The session ends for good: the run finished, or the actor was asked to stop; the message says which."""

    def __init__(self, reason: str, *, finished: bool = False) -> None:
        """`finished`: the run finished, and an actor that stays looks for the next run."""
        super().__init__(reason)
        self.finished = finished


class RunEndWatch:
    """Watch for a local stop and for the RunEnded messages of one run after the other. For one thread."""

    def __init__(self, transport: Transport, stop: threading.Event, on_news: Callable[[], None] = lambda: None) -> None:
        """`on_news` is called on the transport's threads when a message has come."""
        self._transport, self._stop, self._on_news = transport, stop, on_news
        self._inboxes: dict[str, Inbox] = {}  # by run
        self.run, self.learner_epoch = "", -1  # of the learner that is followed; an empty name before the first
        self.learner_stopped = False  # since `follow`

    def follow(self, run: str, learner_epoch: int) -> None:
        """Follow a learner from now on."""
        self.run, self.learner_epoch, self.learner_stopped = run, learner_epoch, False
        if run not in self._inboxes:
            self._inboxes[run] = self._transport.subscribe(keys.run_end(run), self._on_news)

    def check(self) -> None:
        """Raise RunOverError on a local stop or if the run finished; note if the learner was stopped."""
        if self._stop.is_set():
            raise RunOverError("stopped")
        inbox = self._inboxes.get(self.run)
        data = None if inbox is None else inbox.take()
        if data is None:
            return
        try:
            message = decode(data, ACKNOWLEDGEMENT_LIMITS)
        except ProtocolError:
            return
        if isinstance(message, RunEnded):
            self.apply(message)

    def apply(self, message: RunEnded) -> None:
        """Obey a message. Raises RunOverError if the run finished.

        A later learner may have finished the run during a long rollout. An older one that was cut off, from which the
        run was continued elsewhere, has not.
        """
        if message.outcome == "finished" and starts_of(message.learner_epoch) >= starts_of(self.learner_epoch):
            raise RunOverError(f"the run is over: {bounded_text(message.reason, MAX_ANSWER_TEXT)}", finished=True)
        if message.learner_epoch == self.learner_epoch:
            self.learner_stopped = True

    def wait(self, seconds: float) -> None:
        """Wait, then `check`. A local stop ends the wait at once."""
        self._stop.wait(seconds)
        self.check()
