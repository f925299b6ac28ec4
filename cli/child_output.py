"""Output of child processes: written to this process's own streams, or passed on line by line."""

import os
import threading
from collections import deque
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass

_KEPT_LINES = 40
_CLOSE_SECONDS = 5.0


@dataclass(frozen=True, slots=True, kw_only=True)
class Streams:
    """File descriptors for the output of child processes; None is this process's own stream."""

    stdout: int | None = None
    stderr: int | None = None


INHERITED = Streams()


class CollectedOutput:
    """Pipe for the output of child processes. It passes each line to a function and keeps the newest lines.

    A notebook shows only what its own process prints, so children cannot write to its streams themselves.
    """

    def __init__(self, pass_on: Callable[[str], None]) -> None:
        """Start a thread that reads the pipe and calls `pass_on` with each line."""
        reading, self.descriptor = os.pipe()
        self._pass_on = pass_on
        self._lines: deque[str] = deque(maxlen=_KEPT_LINES)
        self._thread = threading.Thread(target=self._read, args=(reading,), name="child-output", daemon=True)
        self._thread.start()

    def close(self) -> str:
        """Wait until the children have closed their ends; return the newest lines. Call it once."""
        os.close(self.descriptor)
        self._thread.join(_CLOSE_SECONDS)
        return "\n".join(self._lines)

    def _read(self, reading: int) -> None:
        with open(reading, encoding="utf-8", errors="replace") as lines:
            for line in lines:
                self._lines.append(line.rstrip("\n"))
                with suppress(OSError, ValueError):  # a closed stream: children must not block on a full pipe
                    self._pass_on(line)
