"""What a learner process sets up with the operating system: descriptors, and an allocator.

Connections of peers use up all file descriptors that are not reserved for the files of the run. A connection is
accepted by the network's own threads, before anybody knows whose it is. So the limit of this process stays below what
the system allows, and is raised only while a thread writes files.
"""

import contextlib
import ctypes
import sys
import threading
from collections.abc import Iterator

_LARGEST_SHARE = 8  # part of all descriptors, at most

_lock = threading.Lock()
_limits: tuple[int, int] | None = None  # for connections, and for all; None: nothing is reserved
_writing = 0  # number of threads


def reserve_descriptors(number: int = 64) -> None:
    """Keep file descriptors of this process for `reserved_descriptors` from now on, at most an eighth of all."""
    global _limits
    try:
        import resource
    except ModuleNotFoundError:  # Windows has no limit
        return
    most, _ = resource.getrlimit(resource.RLIMIT_NOFILE)
    if most == resource.RLIM_INFINITY:
        return
    with _lock:
        _limits = most - min(number, most // _LARGEST_SHARE), most
        _limit(_limits[0])


@contextlib.contextmanager
def reserved_descriptors() -> Iterator[None]:
    """Let this process use the reserved file descriptors during the block, in which the calling thread writes files."""
    global _writing
    with _lock:
        _writing += 1
        if _limits is not None:
            _limit(_limits[1])
    try:
        yield
    finally:
        with _lock:
            _writing -= 1
            if _limits is not None and not _writing:
                _limit(_limits[0])


def _limit(descriptors: int) -> None:
    import resource

    with contextlib.suppress(ValueError, OSError):  # somebody has lowered the hard limit since
        resource.setrlimit(resource.RLIMIT_NOFILE, (descriptors, resource.getrlimit(resource.RLIMIT_NOFILE)[1]))


_M_TRIM_THRESHOLD, _M_MMAP_THRESHOLD = -1, -3  # malloc.h
_NEVER = 2**31 - 1


def keep_freed_memory() -> None:
    """Make the allocator keep freed memory, instead of mapping and unmapping large tensors at each step.

    Call this function before the first tensor is created. It does nothing if the C library is not glibc.
    """
    if not sys.platform.startswith("linux"):
        return
    try:
        mallopt = ctypes.CDLL("libc.so.6").mallopt
    except (OSError, AttributeError):
        return
    mallopt(_M_MMAP_THRESHOLD, 1 << 30)
    mallopt(_M_TRIM_THRESHOLD, _NEVER)
