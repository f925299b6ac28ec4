"""Watchdog of a learner's place on the network. Has its own thread.

It reopens the transport's session if requests no longer reach the learner, and it notices a newer learner of the run.
"""

import contextlib
import logging
import threading
import time
from collections.abc import Callable
from functools import partial

from daedalus.learner.serving.run_context import RunContext
from daedalus.protocol import keys
from daedalus.protocol.codec import ProtocolError, decode, encode
from daedalus.protocol.limits import STATUS_LIMITS
from daedalus.protocol.messages import ActorsReport, ActorsRequest
from daedalus.transport.interface import RefusedError, Transport, TransportError
from daedalus.transport.slow_calls import SlowCall

_logger = logging.getLogger(__name__)

_SILENCE_SECONDS = 10.0  # without any request for so long, the session may be dead
_LOOK_SECONDS = 2.0  # between looks for another learner of the run, and for its answer

# Asks each learner of the run for its epoch: no actor has a name after this one, so the answer is short. Only a learner
# can answer: access control lets actors and operators serve no key.
LOOK = encode(ActorsRequest(after="~"))


class SessionWatchdog:
    """Watchdog of one transport, from `open` to `close`."""

    def __init__(self, context: RunContext, transport: Transport, on_newer: Callable[[int], None]) -> None:
        """`on_newer` is called once, on the watchdog's thread, with the epoch of a newer learner of the run."""
        self._transport, self._on_newer, self._epoch = transport, on_newer, context.learner_epoch
        # This learner serves the key. The session is dead if a query on it over another session has no answer.
        self._status_key = keys.status(context.name)
        self._older: set[int] = set()  # epochs of older learners that were logged
        self._heard_at = self._tried_at = time.monotonic()
        self._closed = threading.Event()
        self._warned = False  # that the certificate is refused
        self._thread = threading.Thread(target=self._watch, name="session watchdog", daemon=True)

    def open(self) -> None:
        """Start the watchdog thread."""
        self._thread.start()

    def close(self) -> None:
        """Stop the watchdog. Does not wait for a session that is being opened."""
        self._closed.set()

    def heard(self) -> None:
        """Record that a request was received, which was not LOOK. Any thread may call this method."""
        self._heard_at = time.monotonic()

    def _watch(self) -> None:
        while not self._closed.wait(_LOOK_SECONDS):
            self._look()
            now = time.monotonic()
            if now > self._heard_at + _SILENCE_SECONDS and now > self._tried_at + _SILENCE_SECONDS / 2:
                self._tried_at = now
                self._reopen()

    def _look(self) -> None:
        """Look for other learners of the run. Calls `on_newer`, and closes the watchdog, if there is a newer one."""
        epochs = self._answering() - {self._epoch}
        if epochs and max(epochs) > self._epoch and not self._closed.is_set():
            self._closed.set()
            self._on_newer(max(epochs))
            return
        for epoch in sorted(epochs - self._older):
            self._older.add(epoch)
            _logger.warning(
                "another learner of this run answers (epoch %x): it is older than this one and steps down", epoch
            )

    def _answering(self) -> set[int]:
        """Return the epochs of the learners that answer."""
        epochs = set[int]()
        with contextlib.suppress(TransportError):  # the session is being replaced
            for answer in self._transport.query(self._status_key, LOOK, timeout=_LOOK_SECONDS):
                with contextlib.suppress(ProtocolError):  # of another release, which cannot be compared
                    report = decode(answer, STATUS_LIMITS)
                    epochs |= {report.page.learner_epoch} if isinstance(report, ActorsReport) else set()
        return epochs

    def _reopen(self) -> None:
        try:
            SlowCall(partial(self._transport.reopen, unless_served=self._status_key)).result.result()
        except RefusedError as error:  # it was revoked or has expired since the start
            if not self._warned:
                _logger.error("the learner cannot connect to its router: %s", error)
            self._warned = True
        except TransportError:
            pass  # no router is reachable: the present session keeps trying to connect
        else:
            self._warned = False
