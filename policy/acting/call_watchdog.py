"""Cancelling calls of onnxruntime that do not return: Python delivers no signal while one runs. State with a thread."""

import threading
import time
import weakref
from collections.abc import Callable

CALL_SECONDS = 60.0  # a policy needs milliseconds
STOP_SECONDS = 1.0  # for a call that is running when the process is asked to stop
_TICK_SECONDS = 0.2


class CallWatchdog:
    """Cancels a call that takes longer than `CALL_SECONDS`, or than `STOP_SECONDS` after `stop`.

    Time is counted in wake-ups of the watchdog's thread: while the process is frozen, no time passes. The thread ends
    when the watchdog is garbage-collected.
    """

    def __init__(self, stop: threading.Event | None) -> None:
        self._stop, self._stopped_at = stop, float("inf")
        self._lock = threading.Lock()  # guards the next three attributes
        self._now = 0.0
        self._began = 0.0
        self._cancel: Callable[[], None] | None = None
        threading.Thread(target=_watch, args=(weakref.ref(self),), name="call-watchdog", daemon=True).start()

    def begin(self, cancel: Callable[[], None]) -> None:
        """Note that a call begins; `cancel` makes it fail soon."""
        with self._lock:
            self._cancel, self._began = cancel, self._now

    def end(self) -> None:
        """Note that the call ended: `cancel` will not be called any more."""
        with self._lock:
            self._cancel = None

    def tick(self) -> None:
        """Let one tick pass, and cancel the call in progress if it is late."""
        with self._lock:
            self._now += _TICK_SECONDS
            if self._stop is not None and self._stop.is_set():
                self._stopped_at = min(self._stopped_at, self._now)
            deadline = min(self._began + CALL_SECONDS, max(self._stopped_at, self._began) + STOP_SECONDS)
            if self._cancel is not None and self._now > deadline:
                self._cancel()


def _watch(reference: weakref.ref[CallWatchdog]) -> None:
    while (watchdog := reference()) is not None:
        watchdog.tick()
        del watchdog
        time.sleep(_TICK_SECONDS)
