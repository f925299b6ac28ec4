"""Progress of a sweep: one line that is rewritten on a terminal, or a line now and then elsewhere."""

import csv
import shutil
import time
from collections.abc import Sequence
from contextlib import suppress
from typing import TextIO

from daedalus.cli.sweeping.plan import PlannedRun
from daedalus.learner.run.run_directory import METRICS
from daedalus.protocol.texts import short_number

_TERMINAL_SECONDS = 1.0  # between lines on a terminal
_LINE_SECONDS = 60.0  # and elsewhere
_TAIL_BYTES = 1 << 13


class Display:
    """Lines about a sweep."""

    def __init__(self, stream: TextIO, total: int) -> None:
        """`total` is the number of runs."""
        self._stream, self._total = stream, total
        self._terminal = stream.isatty()
        self._began = time.monotonic()
        self._next = self._began + (0.0 if self._terminal else _LINE_SECONDS)
        self._first_share: float | None = None
        self._rewriting = False

    @property
    def terminal(self) -> bool:
        """Whether a person watches."""
        return self._terminal

    def say(self, text: str) -> None:
        """Print a permanent line."""
        self._write(f"\r\x1b[K{text}\n" if self._rewriting else f"{text}\n")
        self._rewriting = False

    def show(self, ended: int, failed: int, running: Sequence[PlannedRun]) -> None:
        """Show the progress, if it is time for it."""
        now = time.monotonic()
        if now < self._next:
            return
        self._next = now + (_TERMINAL_SECONDS if self._terminal else _LINE_SECONDS)
        rows = [newest_row(run) for run in running]
        shares = [
            row.get("env_steps", 0.0) / run.spec.training.env_steps for row, run in zip(rows, running, strict=True)
        ]
        parts = [f"{ended} of {self._total} runs", *([f"{failed} failed"] if failed else [])]
        parts.append(self._left((ended + sum(shares)) / max(self._total, 1), now))
        for run, row, share in zip(running, rows, shares, strict=True):
            mean = row.get("episode_return_mean")
            parts.append(f"{run.name} {100 * share:.0f} %" + ("" if mean is None else f" return {short_number(mean)}"))
        if self._terminal:
            self._write(f"\r\x1b[K{'  '.join(parts)[: max(shutil.get_terminal_size().columns - 1, 0)]}")
            self._rewriting = True
        else:
            self._write("  ".join(parts) + "\n")

    def _left(self, share: float, now: float) -> str:
        """Return the time left, from the share of the runs that is done: at most, as runs may reach their target."""
        if self._first_share is None:
            self._first_share = share
            self._began = now
        done = share - self._first_share
        if done <= 0.0:
            return "left -"
        seconds = (now - self._began) * (1.0 - share) / done
        return f"left {seconds:.0f} s" if seconds < 100.0 else f"left {seconds / 60:.0f} min"

    def end(self) -> None:
        """End the line that is being rewritten."""
        if self._rewriting:
            self._write("\n")
            self._rewriting = False

    def _write(self, text: str) -> None:
        with suppress(OSError):  # nobody reads it any more: the sweep goes on
            self._stream.write(text)
            self._stream.flush()


def newest_row(run: PlannedRun) -> dict[str, float]:
    """Return the known values of the newest row of a run's metrics; empty without one.

    Reads the end of the file only, because this is called every second.
    """
    try:
        with open(run.directory / METRICS, "rb") as file:
            header = file.readline()
            start = max(file.seek(0, 2) - _TAIL_BYTES, len(header))
            file.seek(start)
            lines = file.read().split(b"\n")[:-1]  # without the line that is being written
        names, cells = (next(csv.reader([line.decode()])) for line in (header, lines[-1]))
        return {name: float(cell) for name, cell in zip(names, cells, strict=True) if cell}
    except (OSError, ValueError, IndexError, csv.Error, StopIteration):
        return {}
