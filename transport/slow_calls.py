"""Calls of Zenoh that may take 10 s, while the process may have to end sooner. Each runs in a thread of its own."""

import threading
from collections.abc import Callable
from concurrent.futures import Future, wait
from typing import Generic, TypeVar

_POLL_SECONDS = 0.1

Result = TypeVar("Result")


class SlowCall(threading.Thread, Generic[Result]):
    """Call in progress; `result` is what it returns or raises."""

    def __init__(self, function: Callable[[], Result]) -> None:
        """Begin the call."""
        super().__init__(name="slow call")
        self._function = function
        self.result: Future[Result] = Future()
        self.start()

    def run(self) -> None:
        """Call the function. See Thread."""
        try:
            self.result.set_result(self._function())
        except BaseException as error:
            self.result.set_exception(error)

    def wait(self, check: Callable[[], object]) -> Result:
        """Return the result; call `check` again and again meanwhile. What it raises ends the wait, not the call."""
        while not wait([self.result], _POLL_SECONDS).done:
            check()
        return self.result.result()


def in_progress() -> bool:
    """Return whether any call is in progress. If it returns while the interpreter ends, the process aborts."""
    return any(isinstance(thread, SlowCall) for thread in threading.enumerate())
