"""What every process does: stop on signals, end with its parent, and end when one of its threads fails."""

import logging
import os
import signal
import sys
import threading
import time
import traceback

_logger = logging.getLogger(__name__)

# Exit status of a learner that its supervisor stopped; of one that nobody supervises, the status is 0.
STOPPED = 128 + signal.SIGTERM


def stop_on_signals() -> threading.Event:
    """Return an event that SIGTERM and SIGINT set. Call it in the main thread.

    The signal handlers only set the event, so that the process closes its resources before it ends.
    """
    stop = threading.Event()

    def handle(_number: int, _frame: object) -> None:
        stop.set()

    signal.signal(signal.SIGTERM, handle)
    signal.signal(signal.SIGINT, handle)
    return stop


def exit_with_parent(stop: threading.Event) -> None:
    """Set `stop` when standard input ends: the parent holds it open while it runs."""

    def watch() -> None:
        while os.read(sys.stdin.fileno(), 4096):
            pass
        stop.set()

    threading.Thread(target=watch, name="parent-watch", daemon=True).start()


def exit_on_thread_exceptions() -> None:
    """Make an exception in any thread end the process with status 1, with its traceback on standard error.

    An exception that no thread handles is a fault of ours. Without this hook only its thread would end and the process
    would idle; with it a supervisor restarts the process. Call this at the start of a command.
    """

    def end_process(arguments: threading.ExceptHookArgs) -> None:
        name = arguments.thread.name if arguments.thread else "unknown"
        try:
            print(f"exception in thread {name}:", file=sys.stderr)
            traceback.print_exception(arguments.exc_type, arguments.exc_value, arguments.exc_traceback)
            sys.stderr.flush()
            _logger.critical("exception in thread %s: %s: the process ends", name, arguments.exc_type.__name__)
            sys.stdout.flush()
        finally:
            # sys.exit would end only this thread, and an orderly end could wait for the failed thread without end.
            os._exit(1)

    threading.excepthook = end_process


def process_started() -> float:
    """Return the start of this process on the monotonic clock, or the present time where it is not known."""
    now = time.monotonic()
    try:
        with (
            open("/proc/self/stat", encoding="ascii") as stat,
            open("/proc/uptime", encoding="ascii") as uptime,
        ):
            ticks = int(stat.read().rsplit(")", 1)[1].split()[19])
            age = float(uptime.read().split()[0]) - ticks / os.sysconf("SC_CLK_TCK")
    except (OSError, ValueError, IndexError):
        return now
    return now - max(age, 0.0)
