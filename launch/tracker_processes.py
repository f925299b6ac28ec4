"""The processes that log a run to trackers, as the process that started the run sees them.

A tracker runs in a process of its own, with a low priority: its package can neither slow down training, nor fail
or wait in a process of the run.
"""

import argparse
import logging
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Sequence
from contextlib import suppress
from functools import partial
from pathlib import Path

from daedalus.launch.child_output import ChildOutput
from daedalus.launch.logs import configure_logging, say
from daedalus.launch.process_lifecycle import (
    exit_on_thread_exceptions,
    exit_with_parent,
    reserved_stdout,
    stop_on_signals,
)
from daedalus.launch.supervision import start
from daedalus.learner.reporting.trackers.tracker import is_installed, tracker_class, tracker_name
from daedalus.learner.reporting.trackers.tracking import Tracking
from daedalus.learner.run.run_directory import run_name
from daedalus.policy.user_code import first_line, place_of
from daedalus.policy.user_modules import UserModuleError

_END_SECONDS = 150.0  # after the end of the run; a parent that lives ends this process before


def main() -> int:
    """Run the process and return its exit status."""
    options = argparse.ArgumentParser()
    options.add_argument("name", type=tracker_name)
    options.add_argument("directory", type=Path)
    options.add_argument("--service", action="store_true")
    options.add_argument("--log-json", action="store_true")
    options.add_argument("--exit-with-parent", action="store_true")
    parsed = options.parse_args()
    process, context = "tracker" if parsed.service else "", {"run": run_name(parsed.directory)}
    configure_logging(
        as_json=parsed.log_json, process=process, context=context, write=partial(say, stream=reserved_stdout())
    )
    finish = stop_on_signals()
    exit_with_parent(finish)
    threading.Thread(target=_end_in_time, args=(finish,), name="end", daemon=True).start()
    try:
        open_tracker = tracker_class(parsed.name)
    except Exception as error:  # the user's module may raise anything
        fault = str(error) if isinstance(error, UserModuleError) else f"{first_line(error)}{place_of(error)}"
        _logger.warning("%s: %s; the run goes on without it", parsed.name, fault)
        return 1
    done = Tracking(parsed.name, parsed.directory, open_tracker, finish).run()
    os._exit(0 if done else 1)  # packages of trackers wait for the network at the end of the interpreter


def _end_in_time(finish: threading.Event) -> None:
    finish.wait()
    time.sleep(_END_SECONDS)
    os._exit(1)


_FINISH_SECONDS = 120.0  # to start on a busy machine, and to upload what is left at the end of the run
_STOP_SECONDS = 2.5  # the same after Ctrl-C
_QUIET_SECONDS = 2.0  # of waiting, before the user is informed
_POLL_SECONDS = 0.05
_NICENESS = 10  # more than that of actors; with 19, a package may take minutes to import on a busy machine

_logger = logging.getLogger("daedalus.launch.tracker_processes")  # this module is __main__ in the process


class TrackerProcesses:
    """Processes of one run, one for each tracker. The run goes on without those that are missing or fail."""

    def __init__(
        self,
        names: Sequence[str],
        directory: Path,
        output: ChildOutput,
        *,
        service: bool = False,
        log_json: bool = False,
    ) -> None:
        """Construct without starting a process.

        Args:
          names: of the trackers.
          directory: the run directory.
          output: reads what the processes print. It shows their own lines; the log has what their packages print.
          service: write their own lines as those of a service, rather than for a person.
          log_json: write their own lines as JSON objects.
        """
        self._names, self._directory, self._output = names, directory, output
        self._logging = [*(["--service"] if service else []), *(["--log-json"] if log_json else [])]
        self._processes: dict[str, subprocess.Popen[bytes]] = {}

    def start(self) -> None:
        """Start the processes, and warn about trackers that are not installed."""
        for name in self._names:
            if not is_installed(name):
                _logger.warning(
                    "--log %s: not installed, and the run goes on without it; install it with: "
                    "pip install 'daedalus-rl[%s]'",
                    name,
                    name,
                )
                continue
            arguments = (name, str(self._directory), *self._logging)
            with self._output.pipes(name, shown=("stdout",)) as streams:
                process = start("daedalus.launch.tracker_processes", *arguments, streams=streams, own_session=True)
            with suppress(AttributeError, OSError):  # not on every system; and the process may have ended
                os.setpriority(os.PRIO_PROCESS, process.pid, os.getpriority(os.PRIO_PROCESS, 0) + _NICENESS)
            self._processes[name] = process

    def finish(self, stopping: threading.Event) -> None:
        """Let the processes log the end of the run, and end those that take too long.

        Args:
          stopping: set if the user wants the command to end now.
        """
        began, informed = time.monotonic(), False
        for process in self._processes.values():
            _close_input(process)
        while running := [name for name, process in self._processes.items() if process.poll() is None]:
            waited = time.monotonic() - began
            if waited > (_STOP_SECONDS if stopping.is_set() else _FINISH_SECONDS):
                break
            if waited > _QUIET_SECONDS and not informed and not stopping.is_set():
                _logger.info("waiting for %s, at most %.0f s", ", ".join(running), _FINISH_SECONDS)
                informed = True
            time.sleep(_POLL_SECONDS)
        for name, process in self._processes.items():
            _kill(process)
            if process.returncode != 0:
                said = f"; see {self._output.path}" if self._output.path.exists() else ""
                _logger.warning("%s has not received the whole run, which is in %s%s", name, self._directory, said)
        self._processes.clear()


def _close_input(process: subprocess.Popen[bytes]) -> None:
    if process.stdin is not None:
        with suppress(OSError):
            process.stdin.close()


def _kill(process: subprocess.Popen[bytes]) -> None:
    """End a process and those that its package has started."""
    with suppress(AttributeError, OSError):  # no process groups on Windows; and all may have ended
        os.killpg(process.pid, signal.SIGKILL)
    process.kill()
    process.wait()


if __name__ == "__main__":
    exit_on_thread_exceptions()
    sys.exit(main())
