"""What a process may use of its machine, and what it uses, as actors report it, and the learner in its status."""

import math
import mmap
import os
import re
import time
from pathlib import Path
from typing import NamedTuple

CONTROL_GROUP = Path("/sys/fs/cgroup")  # that of this process, as a container sees it


def available_processors() -> int:
    """Return how many processors this process may use: those it may run on, and no more than its container has."""
    found = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    try:
        quota, period = (int(word) for word in (CONTROL_GROUP / "cpu.max").read_text("ascii").split())
        found = min(found, math.ceil(quota / period))  # in microseconds; the quota may be "max"
    except (OSError, ValueError, ZeroDivisionError):
        pass
    return max(found, 1)


def available_memory() -> int | None:
    """Return the bytes of memory that this process can still take, or None where the system does not say."""
    found = []
    try:
        lines = Path("/proc/meminfo").read_text("ascii").splitlines()
        found += [int(line.split()[1]) << 10 for line in lines if line.startswith("MemAvailable:")]
    except (OSError, ValueError, IndexError):
        pass
    try:
        names = ("memory.max", "memory.current", "memory.stat")
        limit, used, statistics = ((CONTROL_GROUP / name).read_text("ascii") for name in names)
        files = re.search(r"^inactive_file (\d+)$", statistics, re.MULTILINE)  # read before, and given up when needed
        found.append(max(int(limit) - int(used) + (int(files[1]) if files else 0), 0))  # the limit may be "max"
    except (OSError, ValueError):
        pass
    return min(found, default=None)


class Usage(NamedTuple):
    """The use of one process, without that of processes that it started."""

    processor_share: float  # of one processor, since the last measurement: 1.5 is one and a half
    memory_bytes: int  # in RAM; 0 where the system is not Linux


class UsageMeter:
    """Measures this process. For one thread."""

    def __init__(self) -> None:
        self._wall, self._processor = time.monotonic(), time.process_time()
        self._usage = Usage(0.0, 0)

    def measure(self, pause: float = 1.0) -> Usage:
        """Return the use now; the last one again if less than `pause` seconds have passed since."""
        wall, processor = time.monotonic(), time.process_time()
        if wall - self._wall >= pause:
            self._usage = Usage((processor - self._processor) / (wall - self._wall), _memory_bytes())
            self._wall, self._processor = wall, processor
        return self._usage


def _memory_bytes() -> int:
    try:
        with open("/proc/self/statm", "rb") as file:  # of Linux, in pages: all, resident, ...
            return int(file.read().split()[1]) * mmap.PAGESIZE
    except (OSError, ValueError, IndexError):
        return 0
