"""What a process uses of its machine, as actors report it to the learner, and the learner in its status."""

import os
import sys
import time
from typing import NamedTuple


class Usage(NamedTuple):
    """The use of one process, without that of processes that it started."""

    processor_share: float  # of one processor, since the last measurement: 1.5 is one and a half
    memory_bytes: int  # in RAM; 0 if the system does not tell


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
    if sys.platform == "linux":
        with open("/proc/self/statm", "rb") as file:  # in pages: all, resident, ...
            return int(file.read().split()[1]) * os.sysconf("SC_PAGE_SIZE")
    try:
        import resource
    except ModuleNotFoundError:  # Windows
        return 0
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss  # the most so far, in bytes on macOS
