"""Modules of the user: which of them this process may import, and their import.

A module runs when it is imported. A module that a peer or a file names is therefore imported only if the command line
of this process allows it.
"""

import contextvars
import importlib
import os
import signal
import sys
import threading
import traceback
import warnings
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np

from daedalus.policy.user_code import shown_path


class NetworkError(Exception):
    """The network of a PolicySpec cannot be built for the spaces; the message says why and what to do."""


class UserModuleError(Exception):
    """Error of a module that is not allowed or cannot be imported. The message is one line and says what to do."""


class MissingModuleError(UserModuleError):
    """Error of a module that is not installed, or that imports one which is not."""


class ModuleNotAllowedError(UserModuleError):
    """Error of settings that name modules which this process does not allow."""

    def __init__(self, reason: str, modules: tuple[str, ...]) -> None:
        """Construct the error from the message without the remedy, and the modules to allow."""
        super().__init__(f"{reason}; if you trust that code, add {' '.join(allow_words(modules))}")
        self.reason, self.modules = reason, modules

    @property
    def in_python(self) -> str:
        """The message for a caller of a function that has `allow_modules`."""
        return f"{self.reason}; if you trust that code, pass allow_modules={list(self.modules)}"


@dataclass(frozen=True, slots=True)
class UserModules:
    """The modules of the user that this process may import."""

    allowed: frozenset[str] = frozenset()
    source: str = "a setting"  # whose settings name modules, such as "the learner" or a path; for messages

    @classmethod
    def of(cls, settings: Mapping[str, str]) -> "UserModules":
        """Return the modules of settings that the user of this process has chosen."""
        return cls(frozenset(modules_of(settings)))

    def check(self, settings: Mapping[str, str]) -> None:
        """Check that all modules that settings name are allowed.

        Args:
          settings: values `module:name` by setting, such as {"environment.wrap": "wrappers:step_costs"}.

        Raises ModuleNotAllowedError, which names all the settings whose modules are not.
        """
        refused = {name: value for name, value in settings.items() if module_of(value) not in self.allowed}
        if refused:
            named = " and ".join(f"{name}={value}" for name, value in refused.items())
            modules = tuple(modules_of(refused))
            words = "the module" if len(modules) == 1 else "the modules"
            reason = f"{self.source} asks for {named}, but {words} {' and '.join(modules)} may not be imported here"
            raise ModuleNotAllowedError(reason, modules)

    def load(self, setting: str, value: str) -> ModuleType:
        """Import the module of a setting `module:name`, also from the working directory.

        Raises UserModuleError if the module is not allowed or not found, and whatever the module raises.
        """
        self.check({setting: value})
        name = module_of(value)
        if name.endswith(".py"):
            raise UserModuleError(f"{setting}={value}: {_of_file(Path(name), value.rpartition(':')[2])}")
        if os.getcwd() not in sys.path:  # at the end: an installed package has precedence
            sys.path.append(os.getcwd())
        if name == "__main__":
            raise UserModuleError(f"{setting}={value}: name the module of the file, without .py, in place of __main__")
        try:
            with _imported(name), USER_STATE.undone():
                return importlib.import_module(name)
        except ImportError as error:
            kind = MissingModuleError if isinstance(error, ModuleNotFoundError) else UserModuleError
            raise kind(f"{setting}={value}: {_import_failure(name, error)}") from error
        except SystemExit as error:  # such as a script that reads its command line
            raise UserModuleError(
                f"{setting}={value}: {name} ends the process when it is imported: "
                'begin what it does as a program with `if __name__ == "__main__":`'
            ) from error

    def attribute(self, setting: str, value: str) -> Any:
        """Import the module of a setting `module:name`, and return what has the name there. See `load`."""
        module, name = self.load(setting, value), value.rpartition(":")[2]
        try:
            return getattr(module, name)
        except AttributeError:
            raise UserModuleError(
                f"{setting}={value}: {file_of(module)} has no {name!r}{hidden_file(module)}"
            ) from None


NO_MODULES = UserModules()


def object_of(module: ModuleType, name: str) -> Any:
    """Return what has a qualified name such as `Class` or `Outer.Inner` in a module, or None."""
    found: Any = module
    for part in name.split("."):
        found = getattr(found, part, None)
    return found


class UserState:
    """What of the interpreter's state code of the user has changed, kept apart from ours.

    Enter it around such code. The code has what it set itself: numpy's handling of floating-point errors, the filters
    of warnings, the standard streams. Outside it is as before: a cast of ours must not raise because an environment
    called `np.seterr(all="raise")`, nor a result be printed to a stream that it put in place. What an import or a
    constructor changes besides, of the recursion limit, torch's defaults and the handlers of SIGINT and SIGTERM, is
    undone: a process must stop, and networks are float32.
    """

    def __init__(self) -> None:
        self._ours: tuple[Any, ...] = ()  # while code of the user runs
        self._theirs: tuple[Any, ...] | None = None  # if it differs
        self._depth = 0

    @property
    def differs(self) -> bool:
        """Whether code of the user has changed anything that it keeps."""
        return self._theirs is not None

    def __enter__(self) -> None:
        self._depth += 1
        if self._depth == 1:
            self._ours = _kept_state()
            if self._theirs is not None:
                _restore(self._theirs)

    def __exit__(self, *_error: object) -> None:
        self._depth -= 1
        if not self._depth:
            now, self._theirs = _kept_state(), None
            if not _are_same(now, self._ours):
                self._theirs = now
                _restore(self._ours)

    @contextmanager
    def watched(self) -> Iterator[None]:
        """Undo what a block changes that enters this state for each part of the user's code: the rest of it is ours."""
        ours = _kept_state()
        try:
            yield
        finally:
            now = _kept_state()
            if not _are_same(now, ours):
                self._theirs = now
                _restore(ours)

    @contextmanager
    def undone(self) -> Iterator[None]:
        """Enter it for an import or a constructor."""
        outer = self._depth == 0
        before = _undone_state() if outer else ()
        try:
            with self:
                yield
        finally:
            if outer:
                _undo(before)


# numpy 2 keeps its handling of errors in a context variable. To copy all of these takes a tenth of np.geterr's time,
# which is a twentieth of a step of CartPole.
_kept_errors = contextvars.copy_context if np.lib.NumpyVersion(np.__version__) >= "2.0.0" else np.geterr


def _errors(kept: Any) -> Any:
    """Return the handling of errors that `_kept_errors` has kept, for np.seterr."""
    return kept.run(np.geterr) if isinstance(kept, contextvars.Context) else kept


def _kept_state() -> tuple[Any, ...]:
    return _kept_errors(), list(warnings.filters), sys.stdout, sys.stderr


def _are_same(one: tuple[Any, ...], other: tuple[Any, ...]) -> bool:
    """Return whether two results of _kept_state agree, whatever other context variables may be."""
    return one == other or (one[1:] == other[1:] and _errors(one[0]) == _errors(other[0]))


def _restore(state: tuple[Any, ...]) -> None:
    errors, filters, sys.stdout, sys.stderr = state
    np.seterr(**_errors(errors))
    warnings.resetwarnings()
    warnings.filters[:] = filters  # pyright: ignore[reportIndexIssue]


def _undone_state() -> tuple[Any, ...]:
    handlers = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
    # Another thread may be importing it, such as a learner's in the same process: then this waits until it has.
    torch = importlib.import_module("torch") if "torch" in sys.modules else None
    return handlers, sys.getrecursionlimit(), torch and (torch.get_default_dtype(), torch.get_default_device())


def _undo(before: tuple[Any, ...]) -> None:
    (handlers, limit, defaults), now = before, _undone_state()
    if threading.current_thread() is threading.main_thread():
        for number, handler in handlers.items():
            if handler is not None and handler != now[0][number]:
                signal.signal(number, handler)
    if limit != now[1]:
        sys.setrecursionlimit(limit)
    if now[2] is not None and now[2] != defaults:
        torch = sys.modules["torch"]
        dtype, device = defaults or (torch.float32, None)
        torch.set_default_dtype(dtype)
        torch.set_default_device(None if device is None or device.type == "cpu" else device)


USER_STATE = UserState()  # of this process: one thread runs code of the user
_importing = threading.local()


@contextmanager
def _imported(name: str) -> Iterator[None]:
    before, _importing.name = getattr(_importing, "name", ""), name
    try:
        yield
    finally:
        _importing.name = before


def refuse_while_imported(function: str) -> None:
    """Raise RuntimeError if this thread imports a module of the user: `function` starts processes that do, too."""
    if name := getattr(_importing, "name", ""):
        raise RuntimeError(
            f"{function} is called while {name} is imported, which the processes of the run do, too: "
            'put the call under `if __name__ == "__main__":`'
        )


def file_of(module: ModuleType) -> str:
    """Return the file of an imported module, for a message."""
    path = getattr(module, "__file__", None)
    return shown_path(path) if path else f"the module {module.__name__} of Python"


def hidden_file(module: ModuleType) -> str:
    """Return the end of a message if a file of the working directory has an imported module's name but is another."""
    name = f"{module.__name__}.py"
    path = getattr(module, "__file__", None)
    if not os.path.exists(name) or (path and os.path.exists(path) and os.path.samefile(path, name)):
        return ""
    return f"; it was imported in place of {name} of this folder: rename your file"


def _of_file(path: Path, name: str) -> str:
    """Return what to write in place of a file's path."""
    if path.is_absolute() or ".." in path.parts:
        return f"name the module, not its file: start in {path.parent} and write {path.stem}:{name}"
    return f"name the module, not its file: write {'.'.join(path.with_suffix('').parts)}:{name}"


def _import_failure(name: str, error: ImportError) -> str:
    """Return why a module cannot be imported: it is missing, or something that it imports is."""
    missing = isinstance(error, ModuleNotFoundError) and error.name
    if missing and f"{name}.".startswith(f"{error.name}."):
        return f"cannot import {name} ({error}): install it, or start in the folder of {name}.py"
    places = [frame for frame in traceback.extract_tb(error.__traceback__) if not frame.filename.startswith("<")]
    place = places[-1]
    if missing:
        return f"{shown_path(place.filename)} imports {error.name}, which is not installed"
    return f"cannot import {name} ({shown_path(place.filename)}, line {place.lineno}: {error})"


def module_of(value: str) -> str:
    """Return the module in `module:name`."""
    return value.rpartition(":")[0]


def modules_of(settings: Mapping[str, str]) -> list[str]:
    """Return the modules that settings `module:name` name, each once."""
    return list(dict.fromkeys(map(module_of, settings.values())))


def allow_words(modules: Iterable[str]) -> list[str]:
    """Return the words of a command line that allow modules."""
    return [word for module in modules for word in ("--allow-module", module)]


def allow_settings(settings: Mapping[str, str]) -> list[str]:
    """Return the words of a command line that allow the modules of settings `module:name`."""
    return allow_words(modules_of(settings))
