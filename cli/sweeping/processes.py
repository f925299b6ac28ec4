"""The processes of the runs of a sweep: `daedalus train` and `daedalus resume`, a few at a time."""

import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import IO

from daedalus.cli.sweeping.plan import PlannedRun, has_begun
from daedalus.launch.supervision import stop
from daedalus.learner.run.run_directory import remove_failed

FINISHED = {0, 3}  # exit statuses of `daedalus train`: target reached or all steps done, budget used up
_DAEDALUS = [sys.executable, "-P", "-c", "from daedalus.cli.main import main; raise SystemExit(main())"]
_GRACE_SECONDS = 4.4  # from SIGTERM to SIGKILL; a run needs up to 4 s to end its own processes
_GROUP_SECONDS = 0.4  # for killed processes to disappear; both together stay below 5 s
_POLL_SECONDS = 0.01
_TAIL_BYTES = 1 << 14
_LONGEST_REASON = 300  # characters

Start = Callable[[PlannedRun, IO[bytes]], "subprocess.Popen[bytes]"]


def start_training(run: PlannedRun, log: IO[bytes]) -> "subprocess.Popen[bytes]":
    """Start or resume a run. The process ends when this one ends, and is not in the terminal's group for Ctrl-C."""
    if not has_begun(run):
        remove_failed(run.directory)  # what is left of a run that was killed at its start
    words = run.resume_words if has_begun(run) else run.words
    return subprocess.Popen(
        [*_DAEDALUS, *words, "--exit-with-parent"],
        stdin=subprocess.PIPE,
        stdout=log,
        stderr=subprocess.STDOUT,
        start_new_session=True,
    )


@dataclass(slots=True, eq=False)
class _Running:
    run: PlannedRun
    process: "subprocess.Popen[bytes]"
    log: IO[bytes]


class RunProcesses:
    """Processes of runs, at most `jobs` at a time."""

    def __init__(self, jobs: int, start: Start = start_training) -> None:
        self._jobs, self._start = jobs, start
        self._running: list[_Running] = []

    @property
    def full(self) -> bool:
        """Whether no further run may start."""
        return len(self._running) >= self._jobs

    @property
    def runs(self) -> Sequence[PlannedRun]:
        """The runs whose processes were started and have not been collected."""
        return [running.run for running in self._running]

    def begin(self, run: PlannedRun) -> None:
        """Start or continue a run. Raises OSError."""
        run.log.parent.mkdir(parents=True, exist_ok=True)
        log = open(run.log, "ab")  # noqa: SIM115 - closed when the process has ended
        try:
            self._running.append(_Running(run, self._start(run, log), log))
        except BaseException:
            log.close()
            raise

    def collect(self) -> list[tuple[PlannedRun, int]]:
        """Return the runs whose processes have ended since the last call, with their exit statuses."""
        ended = [running for running in self._running if running.process.poll() is not None]
        for running in ended:
            self._running.remove(running)
            running.log.close()
            if running.process.stdin is not None:
                running.process.stdin.close()
        return [(running.run, running.process.returncode) for running in ended]

    def stop(self) -> None:
        """End all processes and their children: those that obey SIGTERM, and the others after a few seconds."""
        processes = [running.process for running in self._running]
        stop(processes, _GRACE_SECONDS)
        _end_groups([process.pid for process in processes])
        self.collect()


def _end_groups(groups: Sequence[int]) -> None:
    """Kill what is left of process groups whose leaders have ended, and wait a moment until nothing is left.

    The learner of a run that had to be killed would hold the lock of the run for a few seconds more.
    """
    deadline = time.monotonic() + _GROUP_SECONDS
    left = set(groups) if hasattr(os, "killpg") else set()  # Windows has no process groups
    while left and time.monotonic() < deadline:
        for group in sorted(left):
            try:
                os.killpg(group, signal.SIGKILL)
            except (ProcessLookupError, PermissionError):  # macOS refuses it where only zombies are left
                left.remove(group)
        if left:
            time.sleep(_POLL_SECONDS)


def reason(log: Path, status: int) -> str:
    """Return why a run failed, in one line, from what it printed last."""
    try:
        with open(log, "rb") as file:
            file.seek(max(file.seek(0, 2) - _TAIL_BYTES, 0))
            lines = file.read().decode(errors="replace").splitlines()
    except OSError:
        lines = []
    lines = [line.strip() for line in lines if line.strip()]
    own = [line for line in lines if re.match(r"daedalus (train|resume): ", line)]
    found = [re.sub(r"^daedalus (train|resume): ", "", line) for line in own] or lines or [f"exit status {status}"]
    return found[-1][:_LONGEST_REASON]
