"""Supervision of child processes: start them, restart them if they die, and end all of them."""

import logging
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence, Set
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from functools import partial
from importlib.util import find_spec
from typing import Literal, Protocol

from daedalus.launch.child_output import ChildOutput, OpenStreams, Streams, inherited
from daedalus.launch.forked_process import ForkedProcess
from daedalus.launch.process_lifecycle import FAILED, STOPPED, interrupts_held

_logger = logging.getLogger(__name__)

GATEWAY, INFERENCE = "gateway", "the inference process"  # names of processes
Inference = Literal["local", "shared", "cuda"]  # where the policies of actors run: see docs/deploy.md
# Exit status that means something for a learner only.
_LEARNERS_RESTARTS = {STOPPED: "was stopped by a signal"}
# Signals of a process that crashes by itself. Others come from outside: an operator, or the system.
_CRASHES = {
    getattr(signal, name)
    for name in ("SIGSEGV", "SIGABRT", "SIGBUS", "SIGFPE", "SIGILL", "SIGTRAP", "SIGSYS")
    if hasattr(signal, name)
}

_MOST_FAILURES = 3  # of one process, in a row
_SOON_SECONDS = 60.0  # a process that ran for longer before it ended starts a new count
_MOST_RESTARTS = 1000  # of one process that is killed from outside
_REPORT_SECONDS = 5.0  # from the end of an evaluator that failed to that of its host, even on a busy machine
_LEAVING_SECONDS = 30.0  # between the end of the first process and the end of the others
_GRACE_SECONDS = 4.0  # from SIGTERM to SIGKILL
LEARNER_GRACE_SECONDS = 30.0  # the same for a learner: it waits for a slow disk, but not longer, and ends by itself

_ACTOR_ERROR = "daedalus actor: "  # beginning of the line in which an actor reports its error

# With fewer cores than processes, the learner runs first, because all actors wait for it.
_ACTORS_NICENESS = 5  # added to the niceness of the learner

# An actor uses one core. Thread pools of its libraries would take time on the cores of other processes.
_ONE_THREAD = {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1", "MKL_NUM_THREADS": "1"}


def start(
    module: str,
    *arguments: str,
    streams: Streams,
    descriptors: tuple[int, ...] = (),
    one_thread: bool = False,
    own_session: bool = False,
) -> subprocess.Popen[bytes]:
    """Start `python -m module` with a pipe as its standard input.

    The pipe closes when this process ends for any reason, and the child process then ends by itself.

    Args:
      module: the module to run.
      arguments: its command line.
      streams: its standard output and standard error.
      descriptors: file descriptors that it inherits.
      one_thread: limit the thread pools of its libraries.
      own_session: keep it out of the terminal's group for Ctrl-C. It leads a process group of its own.
    """
    with interrupts_held():
        return subprocess.Popen(
            [sys.executable, "-P", "-m", module, *arguments, "--exit-with-parent"],
            stdin=subprocess.PIPE,
            stdout=streams.stdout,
            stderr=streams.stderr,
            env={**os.environ, **_ONE_THREAD} if one_thread else None,
            pass_fds=descriptors,
            start_new_session=own_session,
        )


Child = subprocess.Popen[bytes] | ForkedProcess


class StartPlayer(Protocol):
    """Function that starts a process which makes environments. See `start`."""

    def __call__(self, module: str, *arguments: str, streams: Streams, one_thread: bool = False) -> Child:
        """Start the process."""
        ...


class FailedError(Exception):
    """Error of a process that failed too often. `reason` says why, as far as it is known."""

    def __init__(self, name: str, reason: str, how: str) -> None:
        super().__init__(f"{name} {how}: {reason}")
        self.reason = reason


def _reason(status: int) -> str:
    """Return why a process failed, from its exit status."""
    return f"a fault of native code (signal {-status})" if status < 0 else "see the error above"


@dataclass(slots=True)
class Supervised:
    """Process that is restarted when it dies before its work is done."""

    name: str
    begin: Callable[[bool], Child]  # starts the process; the argument is True for the first start
    ended: Set[int]  # exit statuses that mean that the work is done
    # Exit statuses of a process that has not failed by itself, and how it ended.
    no_fault: Mapping[int, str] = field(default_factory=lambda: _LEARNERS_RESTARTS)
    reason: Callable[[int], str] = _reason  # of its last failure, from the exit status
    most_restarts: int = _MOST_RESTARTS
    restarts: int = 0
    failures: int = 0  # in a row, each soon after the start
    process: Child = field(init=False)
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
        """Whether the first process failed soon after its start, so that a restart would not help."""
        status = self.process.poll()
        failed = status is not None and status > 0 and status not in {*self.no_fault, *self.ended}
        return failed and self.restarts == 0 and time.monotonic() - self._started < _SOON_SECONDS

    def check(self) -> str | None:
        """Restart the process if it died, and return a message about the restart, or None.

        A process whose work is done is restarted if the other processes continue: a learner has been restarted since.
        Raises FailedError if the process failed or crashed too often, soon after each start. A process that is killed
        from outside has not failed.
        """
        status, now = self.process.poll(), time.monotonic()
        if status is None:
            return None
        if status in self.ended:
            self._ended_at = self._ended_at or now
            if now < self._ended_at + _LEAVING_SECONDS:
                return None
            # The code of a user may end its process with the status of one whose work is done.
            self.failures = self.failures + 1 if self._ended_at - self._started < _SOON_SECONDS else 0
            if self.failures >= _MOST_FAILURES:
                raise FailedError(self.name, self.reason(status), f"ended {self.failures} times before the run")
            self.restarts += 1
            self._start(first=False)
            return f"{self.name} ended before the run; started again"
        if now - self._started >= _SOON_SECONDS:
            self.failures = 0
        self.failures += -status in _CRASHES if status < 0 else status not in self.no_fault
        if self.failures >= _MOST_FAILURES:
            raise FailedError(self.name, self.reason(status), f"failed {self.failures} times")
        if self.restarts >= self.most_restarts:
            memory = "; check whether it was for lack of memory" if status == -getattr(signal, "SIGKILL", 9) else ""
            raise FailedError(
                self.name, f"it {self._describe(status)}{memory}", f"was started {self.restarts + 1} times"
            )
        self.restarts += 1
        self._start(first=False)
        return f"{self.name} {self._describe(status)}; started again"

    def _describe(self, status: int) -> str:
        """Return how the process ended, which had more to do."""
        if status in self.no_fault:
            return self.no_fault[status]
        return f"was killed by signal {-status}" if status < 0 else f"failed with status {status}"


def supervised_actor(
    name: str,
    connect: str,
    options: Sequence[str] = (),
    open_streams: OpenStreams = inherited,
    last_error: Callable[[str], str] = lambda _: "",
    start: StartPlayer = start,
) -> Supervised:
    """Start an actor, or the evaluator, under supervision.

    Args:
      name: of the actor.
      connect: address of the learner.
      options: further options of `daedalus actor`. The caller may change a list: each start reads it again.
      open_streams: where its output goes.
      last_error: returns the last line of standard error of a process by its name; it says why an actor failed.
      start: starts the process.
    """

    def begin(_first: bool) -> Child:
        arguments = ["--connect", connect, "--name", name, *options]
        with open_streams(name) as streams:
            process = start("daedalus.cli.commands.actor", *arguments, streams=streams, one_thread=True)
        _yield_to_learner(process)
        return process

    def reason(status: int) -> str:
        said = last_error(name).removeprefix(_ACTOR_ERROR) if status == 1 else ""
        how = f"signal {-status}" if status < 0 else f"status {status}"
        return said or f"the environment ends the process ({how}): play it with `daedalus check`"

    return Supervised(name, begin, ended={0}, no_fault={}, reason=reason)


@contextmanager
def evaluators(
    address: str, names: Sequence[str], options: tuple[str, ...], output: ChildOutput, start: StartPlayer = start
) -> Iterator[Callable[[], str]]:
    """Start evaluators of this machine, and end them at the end.

    Args:
      address: private, of an EvaluatorHost.
      names: of the evaluators. What the first one prints is shown.
      options: further options of `daedalus actor`.
      output: reads what they print.
      start: starts each process.

    Yields a function that restarts those that died, and returns why one failed for good, or an empty string.
    """
    started: list[Supervised] = []
    failed_at: dict[int, float] = {}  # by process id

    def failure() -> str:
        now = time.monotonic()
        for each in started:
            process = each.process
            if process.poll() == FAILED and now < failed_at.setdefault(process.pid, now) + _REPORT_SECONDS:
                continue  # it has told the host why, which then ends the episodes
            try:
                restarted = each.check()
            except FailedError as error:
                return str(error)
            if restarted:
                _logger.warning("%s", restarted)
        return ""

    try:
        for name in names:
            streams = output.pipes if name == names[0] else partial(output.pipes, shown=())
            each = supervised_actor(name, address, (*options, "--evaluator"), streams, output.last_error, start)
            # Until the end of the block, every end of a process is a failure. They play few episodes: if one is killed
            # again and again, there is a reason.
            each.ended, each.most_restarts = frozenset(), _MOST_FAILURES - 1
            started.append(each)
        yield failure
    finally:
        stop([each.process for each in started])


def check_inference(inference: Inference) -> None:
    """Raise ValueError if this system cannot share a policy between processes."""
    if inference != "local" and not hasattr(os, "memfd_create"):
        raise ValueError(f"--inference {inference} needs Linux: leave it out")
    if inference == "cuda" and find_spec("torch") is None:
        raise ValueError('--inference cuda needs torch: pip install "daedalus-rl[learner]", or use --inference shared')


def supervised_inference(
    inference: Inference, folder: str, options: Sequence[str], open_streams: OpenStreams = inherited
) -> tuple[list[Supervised], list[str]]:
    """Start the process that runs the policies of actors, if they do not run their own.

    Args:
      inference: where the policies run.
      folder: private, for its socket.
      options: of its log.
      open_streams: where its output goes.

    Returns the process, if there is one, and the options of the actors.
    """
    if inference == "local":
        return [], []
    path = os.path.join(folder, "policy")

    def begin(_first: bool) -> Child:
        arguments = [path, *(["--device", "cuda"] if inference == "cuda" else []), *options]
        with open_streams("inference") as streams:
            # Ctrl-C does not reach it: it ends after the actors. It does not yield: all actors wait for it.
            return start(
                "daedalus.launch.inference_process", *arguments, streams=streams, one_thread=True, own_session=True
            )

    actors = ["--inference-at", path, *(["--runtime", "torch"] if inference == "cuda" else [])]
    return [Supervised(INFERENCE, begin, ended=frozenset(), no_fault={})], actors


def supervised_gateway(connect: str, options: tuple[str, ...], open_streams: OpenStreams) -> Supervised:
    """Start the gateway of a run under supervision, at an address of this machine, for whoever watches the run.

    Ctrl-C does not reach it: it ends after the learner, so that its pages show the end of the run.
    """

    def begin(_first: bool) -> Child:
        arguments = ["--connect", connect, "--or-any-port", *options]
        with open_streams(GATEWAY) as streams:
            process = start(
                "daedalus.cli.commands.gateway", *arguments, streams=streams, one_thread=True, own_session=True
            )
        _yield_to_learner(process)
        return process

    return Supervised(GATEWAY, begin, ended={0}, no_fault={})


def _yield_to_learner(process: Child) -> None:
    """Let the learner run first."""
    with suppress(AttributeError, OSError):  # not on every system; and the process may have ended
        niceness = os.getpriority(os.PRIO_PROCESS, 0) + _ACTORS_NICENESS
        os.setpriority(os.PRIO_PROCESS, process.pid, niceness)


def ask_to_end(process: Child) -> None:
    """Send SIGTERM; on Windows, where that kills, end its standard input, as the end of its parent does."""
    if hasattr(os, "killpg") or process.stdin is None:
        process.terminate()
    else:
        process.stdin.close()


def stop(*groups: Sequence[Child], grace_seconds: float = _GRACE_SECONDS) -> None:
    """End groups of processes in turn: ask all of a group, wait, then kill those that are left. The grace is of all."""
    deadline = time.monotonic() + grace_seconds
    for processes in groups:
        for process in processes:
            if process.poll() is None:
                ask_to_end(process)
        for process in processes:
            try:
                process.wait(max(deadline - time.monotonic(), 0.0))
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()
            if process.stdin is not None:
                process.stdin.close()
