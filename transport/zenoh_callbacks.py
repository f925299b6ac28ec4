"""The functions of ours that Zenoh holds, each with a Python thread that Zenoh starts for it."""

import threading
from collections.abc import Callable
from typing import Any

import zenoh

from daedalus.transport.threads import report_exceptions

_RELEASE_SECONDS = 2.0  # for Zenoh to release callbacks when a session is closed


class Callbacks:
    """The callbacks of a transport: counts them until Zenoh has released them, and reports what they raise.

    Zenoh would log an exception of a callback and carry on. A process that ends while Zenoh's threads still hold
    callbacks aborts now and then, so a transport waits for their release when it closes.
    """

    def __init__(self) -> None:
        self._changed = threading.Condition()
        self._held = 0

    def hold(self, function: Callable[[Any], None], at_end: Callable[[], None] = lambda: None) -> Any:
        """Return `function` as the callback that Zenoh takes.

        `at_end` is called once, after the last call of `function`. Exceptions of both reach `threading.excepthook`.
        """
        report_end = report_exceptions(at_end)

        def drop() -> None:
            try:
                report_end()
            finally:
                with self._changed:
                    self._held -= 1
                    self._changed.notify_all()

        with self._changed:
            self._held += 1
        return zenoh.handlers.Callback(report_exceptions(function), drop)

    def await_release(self) -> None:
        """Wait until Zenoh has released all callbacks, for 2 seconds at most."""
        with self._changed:
            self._changed.wait_for(lambda: not self._held, _RELEASE_SECONDS)
