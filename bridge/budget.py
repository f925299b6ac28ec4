"""How many questions a client may have open, and how large together. State with a lock, no threads."""

import threading
from collections.abc import Callable

_HEARTBEAT_SECONDS = 0.2  # how soon a wait notices that the client has gone
_MOST_QUESTIONS = 64
_MOST_BYTES = 64 << 20


class Budget:
    """Whoever reads a client's questions waits here; so does the client then, by the flow control of its connection."""

    def __init__(self) -> None:
        self._changed = threading.Condition()
        self._questions = self._bytes = 0
        self._closed = False

    def take(self, size: int, has_gone: Callable[[], bool]) -> bool:
        """Waits until a question of `size` bytes has room, one that is alone always has it; False if it is in vain."""
        with self._changed:
            while not self._closed and not self._has_room(size):
                self._changed.wait(_HEARTBEAT_SECONDS)
                if has_gone():
                    return False
            self._questions += 1
            self._bytes += size
            return not self._closed

    def _has_room(self, size: int) -> bool:
        fits = self._questions < _MOST_QUESTIONS and self._bytes + size <= _MOST_BYTES
        return fits or not self._questions

    def give_back(self, size: int) -> None:
        """A question has ended."""
        with self._changed:
            self._questions -= 1
            self._bytes -= size
            self._changed.notify_all()

    def close(self) -> None:
        """Nobody waits any more."""
        with self._changed:
            self._closed = True
            self._changed.notify_all()
