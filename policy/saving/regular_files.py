"""Opening files that another machine, or somebody else, may have put there.

A path can lead to a FIFO, whose opening waits for ever, or to a device, whose content never ends. In a run directory
that somebody has sent, it can also be a link to a file of the receiver, which a run that goes on would overwrite:
whoever writes into an existing run directory asks `foreign_entry` first, and opens its files with `open_own`.
"""

import errno
import os
import stat
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from functools import partial
from io import FileIO
from pathlib import Path
from typing import BinaryIO


@contextmanager
def replacing(path: Path, *, private: bool = False) -> Iterator[Path]:
    """Yield the path of a new, empty file, which takes the place of `path` at the end; after an error it is removed.

    Args:
      path: it keeps its content, if it exists, until then.
      private: only its owner may read the new file.

    Raises OSError.
    """
    beside = path.with_name(f".{path.name}.{os.getpid()}.partial")
    try:
        with suppress(FileNotFoundError):  # of a process of this number, or a link of somebody else
            beside.unlink()
        os.close(os.open(beside, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600 if private else 0o666))
        yield beside
        os.replace(beside, path)
    finally:
        beside.unlink(missing_ok=True)


def replace_text(path: Path, text: str, *, private: bool = False) -> None:
    """Write a text in UTF-8, as `replacing` does. Raises OSError."""
    with replacing(path, private=private) as beside:
        beside.write_text(text, "utf-8")


_NONBLOCKING = getattr(os, "O_NONBLOCK", 0)  # Windows has no FIFOs in folders
_NO_LINK = getattr(os, "O_NOFOLLOW", 0)
_SHARING = "checkpoints"  # whose folders have files in common: those of the best
_SEARCHED = (_SHARING, "logs")  # of a run, and of a sweep
# Names and endings of the files of a run. Some are only written at the end of the run: a folder would lose the result.
_FILES = {"heartbeat", "operator-token"}
_FILE_ENDINGS = {".toml", ".json", ".jsonl", ".csv", ".log", ".lock"}
_REMEDY = "remove it, or copy the directory without it"


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


def open_own(path: str | Path, flags: int, mode: int = 0o666) -> int:
    """Open a file of a run directory for writing, and return its descriptor. Never waits, and follows no link.

    Raises OSError, also for what is no regular file, and for a file that has a name elsewhere, too (a hard link).
    """
    try:
        descriptor = os.open(path, flags | _NO_LINK | _NONBLOCKING | getattr(os, "O_CLOEXEC", 0), mode)
    except OSError as error:
        if error.errno == errno.ELOOP:
            raise OSError(errno.ELOOP, "is a link", str(path)) from None
        raise
    if reason := _reason(os.fstat(descriptor)):
        os.close(descriptor)
        raise OSError(errno.EINVAL, reason, str(path))
    return descriptor


def append_own(path: Path, *, private: bool = False) -> FileIO:
    """Open a file of a run directory to append to it, unbuffered; a new one for its owner only. See `open_own`."""
    return open(path, "ab", buffering=0, opener=partial(open_own, mode=0o600 if private else 0o666))


def foreign_entry(directory: Path) -> str:
    """Return what is in a directory that no run writes there, with what to do, or an empty string.

    That is a link, a FIFO, a device or a socket, a file that has a name elsewhere, too, a folder where a run has a
    file, and a file where it has a folder. Of the folders in it, only our own are searched: those of a tracker have
    links of its own. Raises OSError.
    """
    entries = list(os.scandir(directory))
    for entry in entries:
        is_folder, path = entry.is_dir(follow_symlinks=False), Path(entry.name)
        if is_folder and (path.name in _FILES or path.suffix in _FILE_ENDINGS):
            return f"{entry.name} is a folder, but a run has a file of this name: {_REMEDY}"
        if entry.name == _SHARING and entry.is_file(follow_symlinks=False):
            return f"{entry.name} is a file, but a run has a folder of this name: {_REMEDY}"
    shared = set[str]()
    for entry in list(entries):
        if entry.name in _SEARCHED and entry.is_dir(follow_symlinks=False):
            inner = list(os.scandir(entry.path))
            inner += [
                each for folder in inner if folder.is_dir(follow_symlinks=False) for each in os.scandir(folder.path)
            ]
            entries += inner
            shared |= {each.path for each in inner if entry.name == _SHARING}
    for entry in entries:
        found = entry.stat(follow_symlinks=False)
        if not stat.S_ISDIR(found.st_mode) and (reason := _reason(found, shared=entry.path in shared)):
            return f"{os.path.relpath(entry.path, directory)} {reason}: {_REMEDY}"
    return ""


def _reason(found: os.stat_result, *, shared: bool = False) -> str:
    """Return why a file may not be written to, or an empty string. `shared`: it may have several names."""
    if stat.S_ISLNK(found.st_mode):
        return "is a link"
    if not stat.S_ISREG(found.st_mode):
        return "is not a regular file"
    return "has a name elsewhere, too (a hard link)" if found.st_nlink > 1 and not shared else ""
