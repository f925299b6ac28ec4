"""The lock between an actor's own thread and the transport's threads."""

import threading
from types import TracebackType


class StateLock:
    """One lock over the state of an actor's session, and a count of the changes to that state.

    A wait reads `changes`, examines the state without the lock, for as long as that takes, and then calls
    `wait_for_change` with the count: a change in between ends the wait at once.
    """

    def __init__(self) -> None:
        self._condition = threading.Condition()
        self._changes = 0

    @property
    def changes(self) -> int:
        """How many changes were announced so far."""
        with self._condition:
            return self._changes

    def announce_change(self) -> None:
        """Count a change and wake the wait. From any thread, with or without the lock held."""
        with self._condition:
            self._changes += 1
            self._condition.notify_all()

    def wait_for_change(self, changes: int, timeout: float) -> None:
        """Wait until more than `changes` changes were announced, at most `timeout` seconds."""
        with self._condition:
            if self._changes == changes:
                self._condition.wait(timeout)

    def __enter__(self) -> None:
        self._condition.acquire()

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._condition.release()
