"""Reopens the transport's session where nobody is heard and nobody could reach the learner. A thread of its own."""

import contextlib
import threading
import time

from daedalus.transport.interface import Transport, TransportError

_SILENCE_SECONDS = 10.0  # without a request from anybody for so long, the session may be dead


class SessionWatchdog:
    """Watches one transport from `open` to `close`."""

    def __init__(self, transport: Transport, own_key: str) -> None:
        """`own_key` is served here: a session is dead if, seen from outside, nobody answers there."""
        self._transport, self._own_key = transport, own_key
        self._heard_at = time.monotonic()
        self._closed = threading.Event()
        self._thread = threading.Thread(target=self._watch, name="session watchdog", daemon=True)

    def open(self) -> None:
        """Start to watch."""
        self._thread.start()

    def close(self) -> None:
        """Stop to watch; does not wait for a session that is being opened."""
        self._closed.set()

    def heard(self) -> None:
        """Note that a request came in. From any thread."""
        self._heard_at = time.monotonic()

    def _watch(self) -> None:
        while not self._closed.wait(_SILENCE_SECONDS / 2):
            if time.monotonic() > self._heard_at + _SILENCE_SECONDS:
                with contextlib.suppress(TransportError):  # no router there now: the present session goes on looking
                    self._transport.reopen(unless_served=self._own_key)
