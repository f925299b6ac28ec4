"""Folders for temporary files, and an address in one, that only processes of this user can reach.

On loopback every user of the machine could connect, publish snapshots, and send rollouts.
"""

import logging
import os
import shutil
import socket
import stat
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager, suppress

from daedalus.transport.addresses import is_socket_path, socket_address

try:
    import fcntl
except ImportError:  # Windows
    fcntl = None

_logger = logging.getLogger(__name__)

_PREFIX, _NAME, _LOCK = "daedalus-", "learner", "lock"


@contextmanager
def private_address() -> Iterator[str]:
    """Return the address of a Unix socket in a new private folder, which is removed at the end.

    Windows has none: there it is a port of loopback, which other users of the machine reach, and a warning says so.
    """
    if fcntl is None:
        with socket.socket() as free:
            free.bind(("127.0.0.1", 0))
            address = f"tcp/127.0.0.1:{free.getsockname()[1]}"
        _logger.warning("this system has no private sockets: every user of this machine can connect to %s", address)
        yield address
        return
    with socket_folder() as folder:
        yield socket_address(os.path.join(folder, _NAME))


@contextmanager
def socket_folder() -> Iterator[str]:
    """Return a private folder in which a Unix socket with a short name has no path that is too long."""
    chosen = os.path.abspath(tempfile.gettempdir())
    longest = os.path.join(chosen, f"{_PREFIX}12345678", _NAME)
    with private_folder(chosen if fcntl is None or is_socket_path(longest) else "/tmp") as folder:
        yield folder


@contextmanager
def private_folder(parent: str | None = None) -> Iterator[str]:
    """Return a new folder with mode 0700, which is removed at the end; None: in the folder for temporary files.

    First removes those that killed processes have left there.
    """
    parent = os.path.abspath(parent or tempfile.gettempdir())
    _remove_dead(parent)
    with tempfile.TemporaryDirectory(prefix=_PREFIX, dir=parent, ignore_cleanup_errors=True) as folder:
        lock = _locked(folder)
        try:
            yield folder
        finally:
            if lock is not None:
                os.close(lock)


def _locked(folder: str) -> int | None:
    """Return the descriptor of a lock in a folder, which the system releases when this process ends in any way."""
    if fcntl is None:
        return None
    new = os.path.join(folder, f".{_LOCK}")
    descriptor = os.open(new, os.O_RDWR | os.O_CREAT | os.O_EXCL, 0o600)
    with suppress(OSError):  # a file system without locks: the folder stays if this process is killed
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        os.rename(new, os.path.join(folder, _LOCK))  # it is never seen without being locked
    return descriptor


def _remove_dead(parent: str) -> None:
    """Remove the private folders of this user that no process holds locked any more."""
    if fcntl is None:
        return
    with suppress(OSError), os.scandir(parent) as entries:
        for entry in entries:
            if entry.name.startswith(_PREFIX):
                with suppress(OSError):
                    _remove_if_dead(entry.path)


def _remove_if_dead(folder: str) -> None:
    assert fcntl is not None
    flags = os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC
    directory = os.open(folder, flags | os.O_DIRECTORY)
    try:
        if not _is_own(os.fstat(directory)):
            return
        lock = os.open(_LOCK, flags, dir_fd=directory)  # one of another kind, or that is being made, has none
        try:
            found = os.fstat(lock)
            if not _is_own(found) or not stat.S_ISREG(found.st_mode):
                return
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)  # raises an error if its process lives
            shutil.rmtree(folder)  # it follows no links
        finally:
            os.close(lock)
    finally:
        os.close(directory)


def _is_own(found: os.stat_result) -> bool:
    return found.st_uid == os.geteuid() and not stat.S_IMODE(found.st_mode) & 0o077
