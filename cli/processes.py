"""What every process of the system does alike: stop when told to, and not outlive the one that started it."""

import os
import signal
import sys
import threading
import time


def stop_on_signals() -> threading.Event:
    """An event that SIGTERM and SIGINT set. Main thread only.

    The handlers only set the event, so a process ends by its own orderly path.
    """
    stop = threading.Event()

    def handle(_number: int, _frame: object) -> None:
        stop.set()

    signal.signal(signal.SIGTERM, handle)
    signal.signal(signal.SIGINT, handle)
    return stop


def exit_with_parent(stop: threading.Event) -> None:
    """Sets `stop` when standard input ends, which the parent holds open for as long as it lives."""

    def watch() -> None:
        while os.read(sys.stdin.fileno(), 4096):
            pass
        stop.set()

    threading.Thread(target=watch, name="parent-watch", daemon=True).start()


def process_started() -> float:
    """When this process began, on the monotonic clock; on systems that do not tell, now."""
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
