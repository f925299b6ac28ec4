"""What the user's code does to this process: errors, in one line with their place, and another working directory."""

import os
import re
import sys
import traceback
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from types import TracebackType
from typing import Self

from daedalus.protocol.texts import printable

_NOT_OF_USERS = {"daedalus", "gymnasium", "numpy", "torch", *sys.stdlib_module_names}  # packages


def message_line(error: BaseException) -> str:
    """Return the first line of an error's message, or its type if it has none."""
    lines = str(error).strip().splitlines()
    return lines[0].strip() if lines else type(error).__name__


def first_line(error: BaseException) -> str:
    """Return the type of an error and the first line of its message."""
    return f"{type(error).__name__}: {message_line(error)}" if str(error).strip() else type(error).__name__


def frames_of(error: BaseException | None) -> Iterator[TracebackType]:
    """Yield the frames of an exception's traceback, that of the innermost call last."""
    traceback = None if error is None else error.__traceback__
    while traceback is not None:
        yield traceback
        traceback = traceback.tb_next


def is_of_user(frame: TracebackType) -> bool:
    """Return whether a frame runs code of the user, or of a package that it uses."""
    return frame.tb_frame.f_globals.get("__name__", "").partition(".")[0] not in _NOT_OF_USERS


def shown_path(path: str) -> str:
    """Return a path, relative to the working directory if it lies there."""
    return path.removeprefix(os.path.join(os.getcwd(), ""))


def place_of(error: BaseException | None) -> str:
    """Return where the user's code raised an error, as ` (FILE, line N)`, or an empty string."""
    place = ""
    for frame in filter(is_of_user, frames_of(error)):
        place = f" ({shown_path(frame.tb_frame.f_code.co_filename)}, line {frame.tb_lineno})"
    return place


def names_place(text: str) -> bool:
    """Return whether a text names the place of an error, as `place_of` does."""
    return re.search(r" \([^()]+, line \d+\)", text) is not None


def print_traceback(error: BaseException) -> None:
    """Print the user's part of a traceback, or all of it if it has none, to standard error.

    An error in one line is then enough for the terminal: the launcher of a run keeps tracebacks in output.log only.
    """
    part = next(filter(is_of_user, frames_of(error)), error.__traceback__)
    with suppress(OSError, ValueError, AttributeError):  # closed, or none
        sys.stderr.write(printable("".join(traceback.format_exception(type(error), error, part))))
        sys.stderr.flush()


class Surroundings:
    """What a process has by itself and the user's code may change: the working directory, the umask, and the path of
    modules. As a context manager, it restores them at the end: relative paths mean the same as before.
    """

    def __init__(self) -> None:
        """Note them as they are now."""
        self.directory = Path()  # what relative paths begin with
        with suppress(OSError):  # it has been removed
            self.directory = Path.cwd()
        self._umask = os.umask(0o077)  # which cannot be read otherwise; meanwhile files of other threads are private
        os.umask(self._umask)
        self._modules = list(sys.path)

    def restore(self) -> None:
        """Restore them. What was added to the path of modules stays: a module of the user may import more later."""
        with suppress(OSError):
            os.chdir(self.directory)
        os.umask(self._umask)
        sys.path.extend(entry for entry in self._modules if entry not in sys.path)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_error: object) -> None:
        self.restore()
