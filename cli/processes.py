"""Signals and lifetime of processes: stop on SIGTERM and SIGINT, and end with the parent process."""

import os
import signal
import sys
import threading
import time


def stop_on_signals() -> threading.Event:
    """Return an event that SIGTERM and SIGINT set. Call it in the main thread.

    The handlers only set the event, so that the process can save its state before it ends.
    """
    stop = threading.Event()

    def handle(_number: int, _frame: object) -> None:
        stop.set()

    signal.signal(signal.SIGTERM, handle)
    signal.signal(signal.SIGINT, handle)
    return stop


def exit_with_parent(stop: threading.Event) -> None:
    """Set `stop` when standard input ends. The parent process holds standard input open while it runs."""

    def watch() -> None:
        while os.read(sys.stdin.fileno(), 4096):
            pass
        stop.set()

    threading.Thread(target=watch, name="parent-watch", daemon=True).start()


def process_started() -> float:
    """Return the start time of this process on the monotonic clock, or the time now where it is not known."""
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
