"""Opening files that another machine, or somebody else, may have put there.

A path can lead to a FIFO, whose opening waits for ever, or to a device, whose content never ends.
"""

import errno
import os
import stat
from pathlib import Path
from typing import BinaryIO

_NONBLOCKING = getattr(os, "O_NONBLOCK", 0)  # Windows has no FIFOs in folders


def open_regular(path: Path) -> BinaryIO:
    """Open a regular file for reading. Never waits. Raises OSError, also for any other kind of file."""
    file = open(path, "rb", opener=lambda name, flags: os.open(name, flags | _NONBLOCKING))  # noqa: SIM115 - returned
    if not stat.S_ISREG(os.fstat(file.fileno()).st_mode):
        file.close()
        raise OSError(errno.EINVAL, "not a regular file", str(path))
    return file


def read_regular(path: Path, limit: int) -> bytes:
    """Return the first `limit` bytes of a regular file. Raises OSError."""
    with open_regular(path) as file:
        return file.read(min(limit, os.fstat(file.fileno()).st_size))
