"""Modules of the user: which of them this process may import, and their import.

A module runs when it is imported. A module that a peer or a file names is therefore imported only if the command line
of this process allows it.
"""

import importlib
import os
import sys
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from types import ModuleType
from typing import Any


class UserModuleError(Exception):
    """Error of a module that is not allowed or cannot be imported. The message is one line and says what to do."""


class ModuleNotAllowedError(UserModuleError):
    """Error of settings that name modules which this process does not allow."""

    def __init__(self, reason: str, modules: tuple[str, ...]) -> None:
        """Construct the error from the message without the remedy, and the modules to allow."""
        super().__init__(f"{reason}; if you trust that code, add {' '.join(allow_words(modules))}")
        self.reason, self.modules = reason, modules


@dataclass(frozen=True, slots=True)
class UserModules:
    """The modules of the user that this process may import."""

    allowed: frozenset[str] = frozenset()
    source: str = "a setting"  # whose settings name modules, such as "the learner" or a path; for messages

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
        if os.getcwd() not in sys.path:  # at the end: an installed package has precedence
            sys.path.append(os.getcwd())
        try:
            return importlib.import_module(name)
        except ImportError as error:
            raise UserModuleError(
                f"{setting}={value}: cannot import {name} ({error}): install it, or start in the folder of {name}.py"
            ) from error

    def attribute(self, setting: str, value: str) -> Any:
        """Import the module of a setting `module:name`, and return what has the name there. See `load`."""
        module, name = self.load(setting, value), value.rpartition(":")[2]
        try:
            return getattr(module, name)
        except AttributeError:
            raise UserModuleError(f"{setting}={value}: {getattr(module, '__file__', module)} has no {name!r}") from None


NO_MODULES = UserModules()


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
