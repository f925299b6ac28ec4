"""A limit of time for `close` of an environment."""

import signal
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager

CLOSE_SECONDS = 5.0
_NEXT_SECONDS = 1.0  # for each further environment that does not return


@contextmanager
def limited_close() -> Iterator[None]:
    """Raise TimeoutError in the block after `CLOSE_SECONDS`, and again every second: a simulator may not return.

    What was played would be lost. It works in the main thread of a system that has timers, and does not interrupt
    native code.
    """
    if threading.current_thread() is not threading.main_thread() or not hasattr(signal, "setitimer"):  # Windows
        yield
        return

    def interrupt(_number: int, _frame: object) -> None:
        raise TimeoutError("it does not return")

    handler, began = signal.signal(signal.SIGALRM, interrupt), time.monotonic()
    remaining, interval = signal.setitimer(signal.ITIMER_REAL, CLOSE_SECONDS, _NEXT_SECONDS)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0.0)
        signal.signal(signal.SIGALRM, handler)
        if remaining:  # somebody else's timer goes on
            signal.setitimer(signal.ITIMER_REAL, max(remaining - (time.monotonic() - began), 0.001), interval)
