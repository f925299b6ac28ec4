"""Starts processes, restarts actors that die, ends them all. Leaves none behind."""

import os
import subprocess
import sys
import time
from contextlib import suppress
from dataclasses import dataclass, field

_MOST_FAILURES = 3  # of one actor's own doing, by exit status
_MOST_RESTARTS = 1000  # of one actor killed from outside
_GRACE_SECONDS = 4.0  # from SIGTERM to SIGKILL

# Where there are fewer cores than processes, the learner comes first: it is the one that all others wait for.
_ACTORS_NICENESS = 5  # beyond the learner's

# An actor has one core at most: pools of threads in its libraries would only spin on everybody else's.
_ONE_THREAD = {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1", "MKL_NUM_THREADS": "1"}


def start(module: str, *arguments: str, one_thread: bool = False) -> subprocess.Popen[bytes]:
    """Starts `python -m module` with its own end of a pipe as standard input.

    The pipe closes when this process is gone, however it went, and the child then ends by itself.
    """
    return subprocess.Popen(
        [sys.executable, "-P", "-m", module, *arguments, "--exit-with-parent"],
        stdin=subprocess.PIPE,
        env={**os.environ, **_ONE_THREAD} if one_thread else None,
    )


class ActorFailedError(Exception):
    """An actor, or the evaluator, failed too often."""


@dataclass(slots=True)
class SupervisedActor:
    """One actor process, started again when it dies. The evaluator is one too."""

    name: str
    connect: str
    options: tuple[str, ...] = ()
    restarts: int = 0
    failures: int = 0
    process: subprocess.Popen[bytes] = field(init=False)

    def __post_init__(self) -> None:
        self._start()

    def _start(self) -> None:
        identity = ("--connect", self.connect, "--name", self.name)
        self.process = start("actor", *identity, "--quiet", *self.options, one_thread=True)
        with suppress(AttributeError, OSError):  # not everywhere, and it may be gone already
            niceness = os.getpriority(os.PRIO_PROCESS, 0) + _ACTORS_NICENESS
            os.setpriority(os.PRIO_PROCESS, self.process.pid, niceness)

    def check(self) -> str | None:
        """Restarts the process if it died; returns what there is to say about that.

        Raises ActorFailedError if it failed by itself too often.
        """
        status = self.process.poll()
        if status is None or status == 0:  # 0: the run is over
            return None
        if status > 0:
            self.failures += 1
        if self.failures >= _MOST_FAILURES or self.restarts >= _MOST_RESTARTS:
            raise ActorFailedError(f"{self.name} failed {self.failures} times; its error is above")
        self.restarts += 1
        self._start()
        how = f"was killed by signal {-status}" if status < 0 else f"failed with status {status}"
        return f"{self.name} {how}; started again"


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
