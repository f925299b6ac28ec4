"""Why an environment cannot be played, each in one line that says what to do."""

import difflib
import importlib
import os
import sys
from collections.abc import Collection
from types import ModuleType


class EnvironmentSetupError(Exception):
    """The environment cannot be played; the message says why and what to do."""


def first_line(error: BaseException) -> str:
    """The kind of an error and the first line of what it says."""
    said = str(error).strip().splitlines()
    return f"{type(error).__name__}: {said[0].strip()}" if said else type(error).__name__


def unknown_environment(name: str, known: Collection[str], otherwise: str) -> EnvironmentSetupError:
    """That nothing of this name is known, with the known names that are near it; `otherwise` if none is."""
    near = difflib.get_close_matches(name, known, 3, 0.5)
    hint = f"did you mean {' or '.join(near)}?" if near else otherwise
    return EnvironmentSetupError(f"unknown environment {name!r}: {hint}")


def import_extra(module: str, extra: str, purpose: str) -> ModuleType:
    """A package that comes with one of our extras and is not there in every installation."""
    try:
        return importlib.import_module(module)
    except ImportError as error:
        raise EnvironmentSetupError(
            f'{purpose} needs a package that is not installed ({error}): pip install "daedalus-rl[{extra}]", '
            "or play another implementation (--set environment.backend=gymnasium)"
        ) from None


def import_user_module(module: str, purpose: str) -> ModuleType:
    """A user's own module, which may lie in the working directory."""
    if os.getcwd() not in sys.path:
        sys.path.append(os.getcwd())
    try:
        return importlib.import_module(module)
    except ImportError as error:
        raise EnvironmentSetupError(
            f"{purpose}: cannot import {module} ({error}): it must lie in the working directory or be installed"
        ) from None
