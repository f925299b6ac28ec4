"""What `daedalus evaluate` shows while it plays."""

import threading
import time
from typing import TextIO

from daedalus.protocol.texts import short_number

_SECONDS = 5.0  # between two lines


class EvaluationStoppedError(Exception):
    """Error of an evaluation that was stopped before its last episode ended."""


class EvaluationProgress:
    """Callback that reports progress every few seconds, and raises EvaluationStoppedError when `stop` is set.

    On a terminal it rewrites one line.
    """

    def __init__(self, stream: TextIO, episodes: int, longest: int, stop: threading.Event) -> None:
        self._stream, self._episodes, self._longest, self.stop = stream, episodes, longest, stop
        self._terminal = stream.isatty()
        self._due = time.monotonic() + _SECONDS
        self._rewriting = False

    def __call__(self, finished: int, mean: float) -> bool:
        """Show how many episodes have finished, and their mean return. Return False: the evaluation goes on."""
        if self.stop.is_set():
            raise EvaluationStoppedError
        if time.monotonic() < self._due:
            return False
        self._due = time.monotonic() + _SECONDS
        so_far = (
            f", mean return {short_number(mean)}" if finished else f" (each is cut after {self._longest:,} env_steps)"
        )
        line = f"evaluation: {finished} of {self._episodes} episodes{so_far}"
        self._stream.write(f"\r\x1b[K{line}" if self._terminal else f"{line}\n")
        self._stream.flush()
        self._rewriting = self._terminal
        return False

    def end(self) -> None:
        """Clear the rewritten line."""
        if self._rewriting:
            self._stream.write("\r\x1b[K")
            self._stream.flush()
