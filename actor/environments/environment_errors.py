"""Errors of environments that cannot be created, each with a message of one line that says what to do."""

import difflib
import importlib
from collections.abc import Collection, Iterator
from contextlib import contextmanager
from types import ModuleType

import gymnasium


class EnvironmentSetupError(Exception):
    """The environment cannot be created or stepped; the message says why and what to do."""


def first_line(error: BaseException) -> str:
    """Return the type of an error and the first line of its message."""
    lines = str(error).strip().splitlines()
    return f"{type(error).__name__}: {lines[0].strip()}" if lines else type(error).__name__


def unknown_environment(name: str, known: Collection[str], otherwise: str) -> EnvironmentSetupError:
    """Return an error that suggests the known names closest to `name`, or says `otherwise` if none is close."""
    near = difflib.get_close_matches(name, known, 3, 0.5)
    hint = f"did you mean {' or '.join(near)}?" if near else otherwise
    return EnvironmentSetupError(f"unknown environment {name!r}: {hint}")


def import_extra(module: str, extra: str, purpose: str) -> ModuleType:
    """Import a package that comes with one of our extras. Raises EnvironmentSetupError if it is not installed."""
    try:
        return importlib.import_module(module)
    except ImportError as error:
        raise EnvironmentSetupError(
            f'{purpose} needs a package that is not installed ({error}): pip install "daedalus-rl[{extra}]", '
            "or use another backend (--set environment.backend=gymnasium)"
        ) from None


@contextmanager
def creation_errors(environment: str) -> Iterator[None]:
    """Raise EnvironmentSetupError for anything that the constructor of an environment raises."""
    try:
        yield
    except EnvironmentSetupError:
        raise
    except gymnasium.error.DependencyNotInstalled as error:
        box2d = "box2d" in str(error).lower()
        remedy = 'pip install "daedalus-rl[box2d]"' if box2d else str(error).splitlines()[0]
        raise EnvironmentSetupError(
            f"environment {environment} needs a package that is not installed: {remedy}"
        ) from None
    except Exception as error:  # broad: the constructor of a user's environment may raise anything
        raise EnvironmentSetupError(f"environment {environment} cannot be created: {first_line(error)}") from error
