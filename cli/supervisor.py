"""Starts processes, restarts those that die, ends them all. Leaves none behind."""

import os
import subprocess
import sys
import time
from collections.abc import Callable, Set
from contextlib import suppress
from dataclasses import dataclass, field

from daedalus.cli.child_output import INHERITED, Streams

_MOST_FAILURES = 3  # of one process's own doing, by exit status
_SOON_SECONDS = 60.0  # a failure later than that after its start begins the count anew
_MOST_RESTARTS = 1000  # of one process killed from outside
_LEAVING_SECONDS = 10.0  # from the end of a process's work to that of all the others'
_GRACE_SECONDS = 4.0  # from SIGTERM to SIGKILL

# Where there are fewer cores than processes, the learner comes first: it is the one that all others wait for.
_ACTORS_NICENESS = 5  # beyond the learner's

# An actor has one core at most: pools of threads in its libraries would only spin on everybody else's.
_ONE_THREAD = {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1", "MKL_NUM_THREADS": "1"}


def start(
    module: str, *arguments: str, one_thread: bool = False, streams: Streams = INHERITED
) -> subprocess.Popen[bytes]:
    """Starts `python -m module` with its own end of a pipe as standard input.

    The pipe closes when this process is gone, however it went, and the child then ends by itself.
    """
    return subprocess.Popen(
        [sys.executable, "-P", "-m", module, *arguments, "--exit-with-parent"],
        stdin=subprocess.PIPE,
        stdout=streams.stdout,
        stderr=streams.stderr,
        env={**os.environ, **_ONE_THREAD} if one_thread else None,
    )


class FailedError(Exception):
    """A process failed too often."""


@dataclass(slots=True)
class Supervised:
    """A process that is started again when it dies before its work is over."""

    name: str
    begin: Callable[[bool], subprocess.Popen[bytes]]  # starts it; told whether it is the first time
    ended: Set[int]  # exit statuses that say that its work is over
    restarts: int = 0
    failures: int = 0  # in a row, of its own doing, each soon after its start
    process: subprocess.Popen[bytes] = field(init=False)
    _started: float = field(init=False)
    _ended_at: float | None = None

    def __post_init__(self) -> None:
        self._start(first=True)

    def _start(self, first: bool) -> None:
        self._started, self._ended_at = time.monotonic(), None
        if not first and self.process.stdin is not None:
            self.process.stdin.close()
        self.process = self.begin(first)

    @property
    def failed_at_once(self) -> bool:
        """Whether its first life ended by a failure of its own, soon: to start it again would change nothing."""
        status = self.process.poll()
        failed = status is not None and status > 0 and status not in self.ended
        return failed and self.restarts == 0 and time.monotonic() - self._started < _SOON_SECONDS

    def check(self) -> str | None:
        """Restarts the process if it died; returns what there is to say about that.

        Where its work is over and yet the others go on, it was told so by a learner that has come back since.
        Raises FailedError if it failed by itself too often, soon after its start each time.
        """
        status, now = self.process.poll(), time.monotonic()
        if status is None:
            return None
        if status in self.ended:
            self._ended_at = self._ended_at or now
            if now < self._ended_at + _LEAVING_SECONDS:
                return None
            self._start(first=False)
            return f"{self.name} had left; started again"
        if status > 0:
            lived = now - self._started
            self.failures = self.failures + 1 if lived < _SOON_SECONDS else 1
        if self.failures >= _MOST_FAILURES or self.restarts >= _MOST_RESTARTS:
            raise FailedError(f"{self.name} failed {self.failures} times; its error is above")
        self.restarts += 1
        self._start(first=False)
        how = f"was killed by signal {-status}" if status < 0 else f"failed with status {status}"
        return f"{self.name} {how}; started again"


def supervised_actor(
    name: str, connect: str, options: tuple[str, ...] = (), streams: Streams = INHERITED
) -> Supervised:
    """An actor, or the evaluator, under supervision."""

    def begin(_first: bool) -> subprocess.Popen[bytes]:
        arguments = ["--connect", connect, "--name", name, "--log-level", "warning", *options]
        process = start("daedalus.cli.commands.actor", *arguments, one_thread=True, streams=streams)
        with suppress(AttributeError, OSError):  # not everywhere, and it may be gone already
            niceness = os.getpriority(os.PRIO_PROCESS, 0) + _ACTORS_NICENESS
            os.setpriority(os.PRIO_PROCESS, process.pid, niceness)
        return process

    return Supervised(name, begin, ended={0})


def stop(processes: list[subprocess.Popen[bytes]]) -> None:
    """Ends processes: asks them all, waits, then kills those that are left."""
    for process in processes:
        if process.poll() is None:
            process.terminate()
    deadline = time.monotonic() + _GRACE_SECONDS
    for process in processes:
        try:
            process.wait(max(deadline - time.monotonic(), 0.0))
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()
        if process.stdin is not None:
            process.stdin.close()
