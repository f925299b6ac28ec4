"""What a process uses of its machine, as actors report it to the learner, and the learner in its status."""

import mmap
import time
from typing import NamedTuple


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
