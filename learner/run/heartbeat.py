"""The heartbeat file of a run directory: shows a probe on the same machine whether the learner still works.

It depends neither on the network nor on the number of actors. It holds the time on the monotonic clock, which all
processes of a machine share until it restarts, and which nobody sets.
"""

import contextlib
import os
import threading
import time
from pathlib import Path

from daedalus.learner.run.process_resources import reserved_descriptors
from daedalus.policy.saving.regular_files import open_own, read_regular

HEARTBEAT = "heartbeat"
_BEAT_SECONDS = 1.0
_END_SECONDS = 1.0  # for the last beat to be written
_MAX_SILENCE_SECONDS = 120.0  # longer than one update or one checkpoint takes
_BOOT = Path("/proc/sys/kernel/random/boot_id")


class Heartbeat:
    """Writer of the heartbeat file of one learner process. For the thread that trains."""

    def __init__(self, directory: Path) -> None:
        self._path = directory / HEARTBEAT
        self._due = self._newest = 0.0
        self._thread: threading.Thread | None = None
        self._beaten, self._ended = threading.Event(), False

    def start(self) -> None:
        """Write the beats on a thread of its own from now on, so that a slow disk does not delay the caller."""
        self._thread = threading.Thread(target=self._work, name="heartbeat", daemon=True)
        self._thread.start()

    def clear(self) -> None:
        """Remove the file, at the start and at the end of the process: without a file, nothing is wrong."""
        if self._thread is not None:
            self._ended = True
            self._beaten.set()
            self._thread.join(_END_SECONDS)
            if self._thread.is_alive():  # the disk does not answer
                return
        with contextlib.suppress(OSError):
            self._path.unlink()

    def beat(self) -> None:
        """Renew the file, once a second at most. An error has no effect but that the heartbeat grows old."""
        now = time.monotonic()
        if now < self._due:
            return
        self._due = now + _BEAT_SECONDS
        if self._thread is None:
            self._write(now)
        else:
            self._newest = now
            self._beaten.set()

    def _work(self) -> None:
        while self._beaten.wait() and not self._ended:
            self._beaten.clear()
            self._write(self._newest)

    def _write(self, now: float) -> None:
        with contextlib.suppress(OSError), reserved_descriptors():
            file = open_own(self._path, os.O_WRONLY | os.O_CREAT, 0o644)  # not cut: a full disk has no room for more
            try:
                os.write(file, f"{now:017.3f} {_boot()}\n".encode())
            finally:
                os.close(file)


def silence(directory: Path) -> float | None:
    """Return for how many seconds the learner of a run has been silent, or None if that is no reason for concern."""
    try:
        at, boot = read_regular(directory / HEARTBEAT, 100).decode("ascii").split()
        age = time.monotonic() - float(at)
    except (OSError, ValueError):  # the learner is starting, or the file is being written
        return None
    return age if age > _MAX_SILENCE_SECONDS and boot == _boot() else None


def _boot() -> str:
    """Return what identifies this start of the machine."""
    try:
        return _BOOT.read_text().strip()
    except OSError:
        return "-"
