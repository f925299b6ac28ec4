"""Watchdog that reopens the transport's session if requests no longer reach the learner. Has its own thread."""

import logging
import threading
import time
from functools import partial

from daedalus.transport.interface import RefusedError, Transport, TransportError
from daedalus.transport.slow_calls import SlowCall

_logger = logging.getLogger(__name__)

_SILENCE_SECONDS = 10.0  # without any request for so long, the session may be dead


class SessionWatchdog:
    """Watchdog of one transport, from `open` to `close`."""

    def __init__(self, transport: Transport, own_key: str) -> None:
        """Construct the watchdog. `own_key` is a key that this process serves.

        The session is dead if a query on `own_key` over another session has no answer.
        """
        self._transport, self._own_key = transport, own_key
        self._heard_at = time.monotonic()
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
        """Record that a request was received. Any thread may call this method."""
        self._heard_at = time.monotonic()

    def _watch(self) -> None:
        while not self._closed.wait(_SILENCE_SECONDS / 2):
            if time.monotonic() > self._heard_at + _SILENCE_SECONDS:
                self._reopen()

    def _reopen(self) -> None:
        try:
            SlowCall(partial(self._transport.reopen, unless_served=self._own_key)).result.result()
        except RefusedError as error:  # it was revoked or has expired since the start
            if not self._warned:
                _logger.error("the learner cannot connect to its router: %s", error)
            self._warned = True
        except TransportError:
            pass  # no router is reachable: the present session keeps trying to connect
        else:
            self._warned = False
