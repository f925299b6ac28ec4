"""Output of child processes: every line goes to a log file and, without repetitions and within a rate limit, is shown.

The environments of a user may print at every step: this must neither flood the terminal nor stop the processes.
"""

import os
import queue
import select
import threading
import time
from collections import deque
from collections.abc import Callable, Collection, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager, nullcontext, suppress
from dataclasses import dataclass
from functools import partial
from io import FileIO
from pathlib import Path
from typing import Self

from daedalus.policy.saving.regular_files import append_own
from daedalus.protocol.texts import without_secrets

STREAMS = ("stdout", "stderr")

_LONGEST_LINE = 1 << 16  # bytes; a longer line is split
_LOG_BYTES = 8 << 20  # of the log file, and of the one before it
_SHOWN_AT_ONCE = 40  # lines; afterwards one line in so many seconds
_SECONDS_A_LINE = 5.0
_KEPT_LINES = 40
_SHOWN_AT_END = 5  # error lines of a process that were not shown before: a traceback ends with what matters
_TRACEBACK = "Traceback (most recent call last)"
_REPETITION = 2  # a line that equals one of so many before it is not shown: a warning that every environment repeats
_CLOSE_SECONDS = 5.0
_WAITING_WRITES = 256  # for the log; each has at most 64 KiB
_SLOW_SECONDS = 1.0  # in which a disk has taken one of them
_POLL_SECONDS = 0.02


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
    """Log file of bounded size: when it is full it becomes FILE.1, which is replaced. A full disk is ignored.

    A thread writes, so that a disk that does not answer does not stop the processes, whose pipes would fill up. The
    lines that it cannot take are left out, and the log says how many.
    """

    def __init__(self, path: Path) -> None:
        """Create no file before the first line."""
        self._path, self._bytes = path, 0
        self._file: FileIO | None = None
        self._waiting: queue.Queue[Sequence[bytes] | None] = queue.Queue(_WAITING_WRITES)
        self._thread: threading.Thread | None = None
        self._left_out = 0  # lines

    def write(self, lines: Sequence[bytes]) -> None:
        """Append lines. For one caller at a time."""
        if self._thread is None or not self._thread.is_alive():
            self._thread = threading.Thread(target=self._work, name="output-log", daemon=True)
            self._thread.start()
        note = [f"{self._left_out:,} lines are left out: the disk was slow\n".encode()] if self._left_out else []
        try:
            self._waiting.put([*note, *lines], timeout=0.0 if note else _SLOW_SECONDS)
            self._left_out = 0
        except queue.Full:
            self._left_out += len(lines)

    def close(self) -> None:
        """Write what is left, and close the file, unless the disk does not answer; a further line opens it again."""
        if self._thread is None:
            return
        with suppress(queue.Full):
            self._waiting.put(None, timeout=_CLOSE_SECONDS)
            self._thread.join(_CLOSE_SECONDS)

    def _work(self) -> None:
        while (lines := self._waiting.get()) is not None:
            with suppress(OSError):
                self._append(b"".join(lines))
        self._close_file()

    def _append(self, data: bytes) -> None:
        if self._file is None:
            self._file = append_own(self._path, private=True)
            self._bytes = self._file.tell()
        self._file.write(data)
        self._bytes += len(data)
        if self._bytes > _LOG_BYTES:
            self._close_file()
            os.replace(self._path, self._path.with_name(f"{self._path.name}.1"))

    def _close_file(self) -> None:
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
        self._lock = threading.Lock()  # guards all but the readers
        self.withheld = 0  # lines that should have been shown, and were not
        self._unshown: dict[str, deque[str]] = {}  # newest lines of standard error that were not shown, by process
        self._newest: dict[tuple[str, str], deque[str]] = {}  # newest lines by process and stream
        self._traced: dict[str, bool] = {}  # processes with a traceback, and whether it goes on
        self._readers: dict[str, list[_Reader]] = {}

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

    def last_error(self, name: str) -> str:
        """Return the last line of standard error of a process, or an empty string. Call it after the process's end.

        It names the file with the tracebacks of the process, if there are any.
        """
        self._wait(self._readers.get(name, []))
        with self._lock:
            lines = [line.strip() for line in self._newest.get((name, "stderr"), ())]
            last, traced = next(filter(None, reversed(lines)), ""), name in self._traced
        return f"{last}; the traceback is in {self.path}" if last and traced else last

    def close(self) -> None:
        """Read what is left of the output, and say how many lines were not shown. Call it after the processes' end."""
        self._wait([reader for readers in self._readers.values() for reader in readers])
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
                reader = _Reader(reading, name, partial(take, stream), partial(end, stream))
                self._readers.setdefault(name, []).append(reader)
            yield Streams(**writing)
        finally:
            for descriptor in writing.values():
                os.close(descriptor)
        self._readers[name] = [reader for reader in self._readers[name] if not reader.has_ended]

    def _take(self, name: str, stream: str, lines: list[str], shown: bool) -> None:
        with self._lock:
            self._log.write([f"[{name}] {line}\n".encode() for line in lines])
            if stream == "stderr":
                lines = self._without_tracebacks(name, lines)
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

    def _without_tracebacks(self, name: str, lines: Sequence[str]) -> list[str]:
        """Leave out what stands above the last line of a traceback; say once for each process where it is."""
        kept = []
        for line in lines:
            begins = line.startswith(_TRACEBACK)
            if begins and name not in self._traced:
                kept.append(f"the traceback of {name} is in {self.path}")
            if begins or (self._traced.get(name) and line[:1] in ("", " ")):
                self._traced[name] = True
                self.withheld += 1
                continue
            if name in self._traced:
                self._traced[name] = False
            kept.append(line)
        return kept

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
    def _wait(readers: Sequence["_Reader"]) -> None:
        """Wait until everything that ended processes have written is read."""
        deadline = time.monotonic() + _CLOSE_SECONDS
        while not all(reader.is_up_to_date for reader in readers) and time.monotonic() < deadline:
            time.sleep(_POLL_SECONDS)


class _Reader:
    """A thread that reads a pipe to its end, and passes its lines on."""

    def __init__(self, reading: int, name: str, take: Callable[[list[str]], None], end: Callable[[], None]) -> None:
        """Start to read. `end` is called at the end of the pipe."""
        self._pipe = open(reading, "rb", buffering=0)  # noqa: SIM115 - closed at its end
        self._take, self._end = take, end
        self._rest = b""
        self._reading = threading.Lock()  # held while there is something to read or to pass on
        self.has_ended = False
        threading.Thread(target=self._run, name=f"output-of-{name}", daemon=True).start()

    @property
    def is_up_to_date(self) -> bool:
        """Whether nothing is left to read now.

        The end of the pipe may come much later than that of the process: its own child processes, such as simulators,
        write there, too.
        """
        if not self._reading.acquire(blocking=False):
            return False
        try:
            return self.has_ended or not self._is_readable(milliseconds=0)
        finally:
            self._reading.release()

    def _run(self) -> None:
        while not self.has_ended:
            self._is_readable()
            with self._reading:
                self._read()

    def _is_readable(self, milliseconds: int | None = None) -> bool:
        """Wait for output, or for the end of the pipe."""
        if not hasattr(select, "poll"):  # Windows: the reader waits as it reads, and is up to date at the end
            return True
        poll = select.poll()  # `select.select` refuses descriptors from 1024 on
        poll.register(self._pipe, select.POLLIN)
        return bool(poll.poll(milliseconds))

    def _read(self) -> None:
        data = self._pipe.read(_LONGEST_LINE)
        if not data:
            self._pipe.close()
            if self._rest:
                self._pass([self._rest])
            self._end()
            self.has_ended = True
            return
        *lines, self._rest = (self._rest + data).replace(b"\r", b"\n").split(b"\n")  # progress bars rewrite their line
        if len(self._rest) >= _LONGEST_LINE:
            lines, self._rest = [*lines, self._rest], b""
        self._pass(lines)

    def _pass(self, lines: Sequence[bytes]) -> None:
        self._take([without_secrets(line.decode(errors="replace")) for line in lines])
