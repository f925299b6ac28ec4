"""Lock on a run directory, so that only one learner at a time writes into it."""

import errno
import logging
import os
import re
import socket
import time
from pathlib import Path
from typing import Self

from daedalus.learner.run.heartbeat import HEARTBEAT
from daedalus.learner.run.settings import SettingsError
from daedalus.policy.saving.regular_files import foreign_entry, open_own

try:
    import fcntl
except ImportError:  # Windows
    fcntl = None

_logger = logging.getLogger(__name__)

LOCK = "learner.lock"
_ENDING_SECONDS = 1.0  # in which a holder that is ending releases the lock
_LEAVING_SECONDS = 6.0  # from the death of a launcher to the end of its learner
_POLL_SECONDS = 0.1
_UNSUPPORTED = {errno.ENOLCK, errno.ENOSYS, errno.EOPNOTSUPP}


class RunInUseError(SettingsError):
    """Error of a run directory that another process has locked."""


class RunLock:
    """Lock of one run directory, held by this process and by child processes that inherit its descriptor.

    The operating system releases the lock when the last of them ends or is killed (flock). The file names the holder.
    Over NFS the lock also holds between hosts, from NFS version 4 on; a file system without locks is only warned of.
    """

    def __init__(self, directory: Path) -> None:
        """Lock an existing directory. Raises RunInUseError if another process has locked it, SettingsError otherwise.

        If the holder was killed, its learner may take a few seconds to end: wait for it.
        """
        self.directory = directory
        self.is_held = False  # whether the file system, or the system, has locks
        try:
            if reason := foreign_entry(directory):  # somebody may have sent the directory
                raise SettingsError(f"run directory {directory}: {reason}")
            self._descriptor = open_own(directory / LOCK, os.O_RDWR | os.O_CREAT, 0o644)
        except OSError as error:
            raise SettingsError(f"run directory {directory}: {error.strerror}") from None
        try:
            self._lock()
        except RunInUseError:
            self.close()
            raise

    @property
    def inheritable(self) -> tuple[int, ...]:
        """File descriptors for a child process that is to hold the lock too."""
        return () if fcntl is None else (self._descriptor,)

    def close(self) -> None:
        """Give up this process's part of the lock. Idempotent."""
        if self._descriptor >= 0:
            os.close(self._descriptor)
        self._descriptor = -1

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_error: object) -> None:
        self.close()

    def _lock(self) -> None:
        began = time.monotonic()
        while not self._try():
            process, host = self._holder()
            limit = _ENDING_SECONDS if _is_running(process, host) else _LEAVING_SECONDS
            if time.monotonic() > began + limit:
                holder = f"process {process} on {host}" if process else "another process"
                raise RunInUseError(
                    f"run directory {self.directory} is in use by {holder}: stop it first, or choose another directory"
                )
            time.sleep(_POLL_SECONDS)
        if not self._is_there():
            raise RunInUseError(f"run directory {self.directory} was removed by another process: try again")
        os.ftruncate(self._descriptor, 0)
        os.lseek(self._descriptor, 0, os.SEEK_SET)
        os.write(self._descriptor, f"{os.getpid()} {socket.gethostname()}\n".encode())

    def _try(self) -> bool:
        """Try to lock the file, and return whether another process does not hold it."""
        if fcntl is None:
            _logger.warning("this system has no such locks: start no second learner in %s", self.directory)
            return True
        try:
            fcntl.flock(self._descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            return False
        except OSError as error:
            if error.errno not in _UNSUPPORTED:
                raise SettingsError(f"run directory {self.directory} cannot be locked: {error.strerror}") from None
            _logger.warning(
                "the file system of %s has no locks: start no second learner in this run directory", self.directory
            )
        else:
            self.is_held = True
        return True

    def _is_there(self) -> bool:
        """Return whether the locked file is still the one in the directory: a run that fails at once is removed."""
        try:
            return os.path.samestat(os.fstat(self._descriptor), (self.directory / LOCK).stat())
        except OSError:
            return False

    def _holder(self) -> tuple[int, str]:
        """Return process id and host of the holder, or 0 if the file does not name them."""
        os.lseek(self._descriptor, 0, os.SEEK_SET)
        text = os.read(self._descriptor, 300).decode(errors="replace")
        named = re.fullmatch(r"(\d{1,10}) ([\w.-]{1,255})\n", text)
        return (int(named[1]), named[2]) if named else (0, "")


def lock_idle(directory: Path) -> RunLock:
    """Return the lock of a run that no learner trains, for whoever reads all of it or removes it.

    Where there are no locks, a learner may be at work that has not removed its heartbeat file. Raises RunInUseError,
    SettingsError.
    """
    lock = RunLock(directory)
    if not lock.is_held and (directory / HEARTBEAT).exists():
        lock.close()
        raise RunInUseError(
            f"a learner may be at work in {directory}, where locks do not tell: stop it; if there is none, remove "
            f"{directory / HEARTBEAT}"
        )
    return lock


def is_locked(directory: Path) -> bool:
    """Return whether a process has locked a run directory; False where that is not known."""
    if fcntl is None:
        return False
    try:
        descriptor = os.open(directory / LOCK, os.O_RDONLY | os.O_NONBLOCK)  # a pipe in its place has no writer
    except OSError:
        return False
    try:
        fcntl.flock(descriptor, fcntl.LOCK_SH | fcntl.LOCK_NB)
    except OSError as error:
        return isinstance(error, BlockingIOError)
    finally:
        os.close(descriptor)
    return False


def _is_running(process: int, host: str) -> bool:
    """Return whether a process is known or presumed to run."""
    if not process or host != socket.gethostname():
        return True
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    except OSError:  # of another user
        return True
    return True
