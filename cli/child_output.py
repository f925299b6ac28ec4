"""Output of child processes: every line goes to a log file and, without repetitions and within a rate limit, is shown.

The environments of a user may print at every step: this must neither flood the terminal nor stop the processes.
"""

import os
import threading
import time
from collections import deque
from collections.abc import Callable, Collection, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager, nullcontext, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO, Self

STREAMS = ("stdout", "stderr")

_LONGEST_LINE = 1 << 16  # bytes; a longer line is split
_LOG_BYTES = 8 << 20  # of the log file, and of the one before it
_SHOWN_AT_ONCE = 40  # lines; afterwards one line in so many seconds
_SECONDS_A_LINE = 5.0
_KEPT_LINES = 40
_SHOWN_AT_END = 5  # error lines of a process that were not shown before: a traceback ends with what matters
_REPETITION = 2  # a line that equals one of so many before it is not shown: a warning that every environment repeats
_CLOSE_SECONDS = 5.0


@dataclass(frozen=True, slots=True, kw_only=True)
class Streams:
    """File descriptors for the output of child processes; None is this process's own stream."""

    stdout: int | None = None
    stderr: int | None = None


OpenStreams = Callable[[str], AbstractContextManager[Streams]]  # for one process of this name, started in the block


def inherited(_name: str) -> AbstractContextManager[Streams]:
    """Return this process's own streams."""
    return nullcontext(Streams())


class RateLimit:
    """Token bucket: some lines at once, then one every few seconds. Times are on the monotonic clock, in seconds."""

    def __init__(self, now: float) -> None:
        self._tokens, self._then = float(_SHOWN_AT_ONCE), now

    def take(self, count: int, now: float) -> int:
        """Return how many of the next `count` lines may be shown."""
        self._tokens = min(self._tokens + (now - self._then) / _SECONDS_A_LINE, float(_SHOWN_AT_ONCE))
        self._then = now
        taken = min(count, int(self._tokens))
        self._tokens -= taken
        return taken


class OutputLog:
    """Log file of bounded size: when it is full it becomes FILE.1, which is replaced. A full disk is ignored."""

    def __init__(self, path: Path) -> None:
        """Create no file before the first line."""
        self._path, self._bytes = path, 0
        self._file: BinaryIO | None = None

    def write(self, lines: Sequence[bytes]) -> None:
        """Append lines."""
        with suppress(OSError):
            if self._file is None:
                self._file = open(self._path, "ab", buffering=0)  # noqa: SIM115 - closed in close()
                self._bytes = self._file.tell()
            data = b"".join(lines)
            self._file.write(data)
            self._bytes += len(data)
            if self._bytes > _LOG_BYTES:
                self.close()
                os.replace(self._path, self._path.with_name(f"{self._path.name}.1"))

    def close(self) -> None:
        """Close the file; a further line opens it again."""
        if self._file is not None:
            self._file.close()
        self._file = None


class ChildOutput:
    """Reader of the output of child processes, with a thread for each stream."""

    def __init__(self, log: Path, write_out: Callable[[str], None], write_err: Callable[[str], None]) -> None:
        """Construct the reader.

        Args:
          log: file for all lines.
          write_out, write_err: show a line of standard output, or of standard error. Called by several threads in turn.
        """
        self._log, self.path = OutputLog(log), log
        self._write = {"stdout": write_out, "stderr": write_err}
        now = time.monotonic()
        self._limits = {stream: RateLimit(now) for stream in self._write}
        self._lock = threading.Lock()  # guards all but the threads
        self.withheld = 0  # lines that should have been shown, and were not
        self._unshown: dict[str, deque[str]] = {}  # newest lines of standard error that were not shown, by process
        self._newest: dict[tuple[str, str], deque[str]] = {}  # newest lines by process and stream
        self._threads: dict[str, list[threading.Thread]] = {}

    @contextmanager
    def pipes(self, name: str, *, shown: Collection[str] = STREAMS) -> Iterator[Streams]:
        """Return the streams for one process, which must be started in the block.

        Args:
          name: of the process.
          shown: streams whose lines are shown, within the limit; those of others only go to the log.
        """

        def take(stream: str, lines: list[str]) -> None:
            self._take(name, stream, lines, stream in shown)

        def end(stream: str) -> None:
            if stream == "stderr" and stream in shown:
                self._show_end(name)

        with self._reading(name, take, end) as streams:
            yield streams

    @contextmanager
    def unlimited_pipes(self, name: str) -> Iterator[Streams]:
        """Return the streams for a process whose lines are all shown and not logged. See `pipes`."""
        with self._reading(name, self._show) as streams:
            yield streams

    def unshown(self, name: str) -> list[str]:
        """Return the newest error lines of a process that were not shown. Call it after the end of the process."""
        self._join(self._threads.get(name, []))
        with self._lock:
            return list(self._unshown.get(name, ()))

    def last_error(self, name: str) -> str:
        """Return the last line of standard error of a process, or an empty string. Call it after the process's end."""
        self._join(self._threads.get(name, []))
        with self._lock:
            lines = [line.strip() for line in self._newest.get((name, "stderr"), ())]
        return next(filter(None, reversed(lines)), "")

    def close(self) -> None:
        """Wait until the child processes have closed their streams, and say how many lines were not shown."""
        self._join([thread for threads in self._threads.values() for thread in threads])
        with self._lock:
            self._log.close()
            if self.withheld:
                self._show("stdout", [f"{self.withheld:,} lines of output were not shown; see {self.path}"])

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_error: object) -> None:
        self.close()

    @contextmanager
    def _reading(
        self, name: str, take: Callable[[str, list[str]], None], end: Callable[[str], None] = lambda _: None
    ) -> Iterator[Streams]:
        writing: dict[str, int] = {}
        try:
            for stream in self._write:
                reading, writing[stream] = os.pipe()
                thread = threading.Thread(
                    target=_read, args=(reading, take, end, stream), name=f"output-of-{name}", daemon=True
                )
                self._threads.setdefault(name, []).append(thread)
                thread.start()
            yield Streams(**writing)
        finally:
            for descriptor in writing.values():
                os.close(descriptor)
        self._threads[name] = [thread for thread in self._threads[name] if thread.is_alive()]

    def _take(self, name: str, stream: str, lines: list[str], shown: bool) -> None:
        with self._lock:
            self._log.write([f"[{name}] {line}\n".encode() for line in lines])
            lines = self._without_repetitions(name, stream, lines)
            count = self._limits[stream].take(len(lines), time.monotonic()) if shown else 0
            self._show(stream, lines[:count])
            if stream == "stderr":
                self._unshown.setdefault(name, deque(maxlen=_KEPT_LINES)).extend(lines[count:])
            if shown and count < len(lines):
                if not self.withheld:
                    self._show("stdout", [f"more lines of output are in {self.path} only"])
                self.withheld += len(lines) - count

    def _show_end(self, name: str) -> None:
        """Show the last error lines of a process that has ended, beyond the limit: they say why it ended."""
        with self._lock:
            lines = list(self._unshown.pop(name, ()))[-_SHOWN_AT_END:]
            self.withheld -= len(lines)
            self._show("stderr", lines)

    def _without_repetitions(self, name: str, stream: str, lines: Sequence[str]) -> list[str]:
        newest = self._newest.setdefault((name, stream), deque(maxlen=_REPETITION))
        kept = []
        for line in lines:
            if line not in newest:
                kept.append(line)
            newest.append(line)
        return kept

    def _show(self, stream: str, lines: Sequence[str]) -> None:
        for line in lines:
            with suppress(OSError, ValueError):  # a closed stream: children must not block on a full pipe
                self._write[stream](line)

    @staticmethod
    def _join(threads: Sequence[threading.Thread]) -> None:
        deadline = time.monotonic() + _CLOSE_SECONDS
        for thread in threads:
            thread.join(max(deadline - time.monotonic(), 0.0))


def _read(reading: int, take: Callable[[str, list[str]], None], end: Callable[[str], None], stream: str) -> None:
    """Read a pipe to its end, and pass its lines on; then call `end`."""
    rest = b""
    with open(reading, "rb", buffering=0) as pipe:
        while data := pipe.read(_LONGEST_LINE):
            *lines, rest = (rest + data).replace(b"\r", b"\n").split(b"\n")  # progress bars rewrite their line
            if len(rest) >= _LONGEST_LINE:
                lines, rest = [*lines, rest], b""
            take(stream, [line.decode(errors="replace") for line in lines])
    if rest:
        take(stream, [rest.decode(errors="replace")])
    end(stream)
