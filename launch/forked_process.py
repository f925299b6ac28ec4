"""Forks of this process: child processes that have what no new process can import, such as a class of a notebook.

A fork continues with a copy of the memory of this process, and with the thread that made it. Nothing is pickled.
"""

import importlib
import os
import random
import signal
import subprocess
import sys
import time
import traceback
import warnings
from collections.abc import Callable, Set
from contextlib import suppress
from typing import Any, BinaryIO, NoReturn

from daedalus.launch.child_output import Streams
from daedalus.launch.process_lifecycle import interrupts_held

_POLL_SECONDS = 0.01
_TEXT: dict[str, Any] = {"encoding": "utf-8", "errors": "backslashreplace", "closefd": False, "buffering": 1}
_ZENOH_THREADS = {"acc-0", "app-0", "net-0"}  # of its runtime; each names itself a moment after its start


def why_not_forked() -> str:
    """Return why this process cannot be forked to play, or an empty string."""
    if sys.platform != "linux":  # Apple's frameworks do not work after a fork, and Windows has none
        return f"{sys.platform} cannot fork a program safely"
    if "zenoh" in sys.modules and _ZENOH_THREADS & _thread_names():
        return (
            "this program has opened a Zenoh session, such as that of a daedalus.Client, and a fork could open no other"
        )
    return ""


def _thread_names() -> set[str]:
    names = set()
    for thread in os.listdir("/proc/self/task"):
        with suppress(OSError), open(f"/proc/self/task/{thread}/comm", encoding="utf-8", errors="replace") as name:
            names.add(name.read().strip())
    return names


def open_descriptors() -> set[int]:
    """Return the file descriptors of this process."""
    return {int(name) for name in os.listdir("/proc/self/fd")}


def fork(work: Callable[[], int], standard: tuple[int, int, int], keep: Set[int]) -> int:
    """Start a fork that does some work and ends with the status that it returns; return its process id.

    Args:
      work: what it does.
      standard: descriptors of its standard input, output and error.
      keep: further descriptors that it has. All others lead nowhere in it: a pipe of this process to another child
        process must close when this process ends.
    """
    sys.stdout.flush()
    sys.stderr.flush()
    pid = 0
    try:
        # os.fork calls functions of modules, and Python drops what a handler of a signal raises in them.
        with interrupts_held(signal.SIGTERM), warnings.catch_warnings():
            warnings.simplefilter("ignore", DeprecationWarning)  # Python's, about threads of this process
            pid = os.fork()
            if not pid:
                _run_child(work, standard, keep)
    except BaseException:  # a signal that waited
        if pid:
            os.kill(pid, signal.SIGKILL)
            os.waitpid(pid, 0)
        raise
    return pid


def _run_child(work: Callable[[], int], standard: tuple[int, int, int], keep: Set[int]) -> NoReturn:
    """Do the work of a fork, and end it."""
    status = 1
    try:
        _take_over(standard, keep)
        status = work()
    except SystemExit as end:
        status = end.code if isinstance(end.code, int) else 0 if end.code is None else 1
    except BaseException as error:
        traceback.print_exception(error)
    finally:
        for stream in (sys.stdout, sys.stderr):
            with suppress(OSError, ValueError):
                stream.flush()
        os._exit(status)  # nothing that belongs to the parent may be closed or flushed here


def _take_over(standard: tuple[int, int, int], keep: Set[int]) -> None:
    """Make a new fork a process of its own."""
    nowhere = os.open(os.devnull, os.O_RDWR)
    copies = [os.dup(descriptor) for descriptor in standard]
    for number, copy in enumerate(copies):
        os.dup2(copy, number)
    for descriptor in open_descriptors() - keep - {0, 1, 2, nowhere}:
        with suppress(OSError):  # that of the listing itself
            os.dup2(nowhere, descriptor, inheritable=False)  # not closed: an object of the parent would do it again
    # The streams of the parent may be a notebook's, or locked by one of its threads.
    sys.stdin, sys.stdout, sys.stderr = (os.fdopen(number, mode, **_TEXT) for number, mode in enumerate("rww"))
    sys.__stdin__, sys.__stdout__, sys.__stderr__ = sys.stdin, sys.stdout, sys.stderr
    signal.set_wakeup_fd(-1)
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, signal.SIG_DFL)
    signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGTERM})
    _new_randomness()


def _new_randomness() -> None:
    """Seed the random generators that a module shares: all forks would play the same otherwise."""
    random.seed()
    if "numpy" in sys.modules:
        sys.modules["numpy"].random.seed()
    if torch := sys.modules.get("torch"):
        torch.seed()
        torch.set_num_threads(1)  # the threads of its pool are the parent's


class ForkedProcess:
    """A fork of this process that calls `run_process` of a module, with the interface of a Popen."""

    def __init__(self, module: str, arguments: tuple[str, ...], streams: Streams, keep: Set[int]) -> None:
        """Start the process. See `supervision.start`, and `fork` for `keep`."""
        reading, writing = os.pipe()
        self.stdin: BinaryIO | None = open(writing, "wb", buffering=0)  # noqa: SIM115
        self.returncode: int | None = None
        out, err = (1 if streams.stdout is None else streams.stdout), (2 if streams.stderr is None else streams.stderr)

        def work() -> int:
            sys.argv = [module, *arguments, "--exit-with-parent"]
            importlib.import_module(module).run_process()
            return 0

        try:
            self.pid = fork(work, (reading, out, err), keep)
        except BaseException:
            self.stdin.close()
            raise
        finally:
            os.close(reading)

    def poll(self) -> int | None:
        """Return the exit status, negative after a signal, or None while the process runs."""
        if self.returncode is None:
            pid, status = os.waitpid(self.pid, os.WNOHANG)
            if pid:
                self.returncode = os.waitstatus_to_exitcode(status)
        return self.returncode

    def wait(self, timeout: float | None = None) -> int:
        """Wait for the end, and return the exit status. Raises subprocess.TimeoutExpired."""
        deadline = None if timeout is None else time.monotonic() + timeout
        while (status := self.poll()) is None:
            if deadline is not None and time.monotonic() >= deadline:
                assert timeout is not None
                raise subprocess.TimeoutExpired(str(self.pid), timeout)
            time.sleep(_POLL_SECONDS)
        return status

    def terminate(self) -> None:
        """Send SIGTERM to a process that runs."""
        self._send(signal.SIGTERM)

    def kill(self) -> None:
        """Send SIGKILL to a process that runs."""
        self._send(signal.SIGKILL)

    def _send(self, number: signal.Signals) -> None:
        if self.poll() is None:
            os.kill(self.pid, number)
