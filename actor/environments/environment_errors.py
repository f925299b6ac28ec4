"""Errors of environments that cannot be created, each with a message of one line that says what to do."""

import difflib
import importlib
from collections.abc import Collection, Iterator
from contextlib import contextmanager
from types import ModuleType

import gymnasium
from pydantic import ValidationError

OTHER_BACKEND = "or use another backend (--set environment.backend=gymnasium)"
_MOST_CHARACTERS = 160  # of a space in a message


class EnvironmentSetupError(Exception):
    """The environment cannot be created or stepped; the message says why and what to do."""


def first_line(error: BaseException) -> str:
    """Return the type of an error and the first line of its message."""
    lines = str(error).strip().splitlines()
    return f"{type(error).__name__}: {lines[0].strip()}" if lines else type(error).__name__


def reason_of(error: ValidationError) -> str:
    """Return why a space is not supported, in words."""
    first = error.errors()[0]
    if first["type"] == "less_than_equal":  # the count of a discrete variable
        return f"{first['input']:,} choices of one variable: use at most {first.get('ctx', {}).get('le'):,}"
    return first["msg"].removeprefix("Value error, ")


def unknown_environment(name: str, known: Collection[str], otherwise: str) -> EnvironmentSetupError:
    """Return an error that suggests the known names closest to `name`, or says `otherwise` if none is close."""
    near = difflib.get_close_matches(name, known, 3, 0.5)
    hint = f"did you mean {' or '.join(near)}?" if near else otherwise
    return EnvironmentSetupError(f"unknown environment {name!r}: {hint}")


def import_extra(module: str, extra: str, purpose: str, otherwise: str = "") -> ModuleType:
    """Import a package that comes with one of our extras.

    Args:
      module: its name.
      extra: name of the extra.
      purpose: what needs the package.
      otherwise: what else the user can do.

    Raises EnvironmentSetupError if the package is not installed.
    """
    try:
        return importlib.import_module(module)
    except ImportError as error:
        raise EnvironmentSetupError(
            f'{purpose} needs a package that is not installed ({error}): pip install "daedalus-rl[{extra}]"'
            f"{', ' if otherwise else ''}{otherwise}"
        ) from None


@contextmanager
def creation_errors(environment: str) -> Iterator[None]:
    """Raise EnvironmentSetupError for anything that the constructor of an environment raises."""
    try:
        yield
    except EnvironmentSetupError:
        raise
    except gymnasium.error.DependencyNotInstalled as error:
        extra = next((extra for extra in ("box2d", "mujoco") if extra in str(error).lower()), None)
        remedy = first_line(error) if extra is None else f'pip install "daedalus-rl[{extra}]"'
        raise EnvironmentSetupError(
            f"environment {environment} needs a package that is not installed: {remedy}"
        ) from None
    except Exception as error:  # broad: the constructor of a user's environment may raise anything
        raise EnvironmentSetupError(f"environment {environment} cannot be created: {first_line(error)}") from error


def described(space: object) -> str:
    """Return a space in one short line: gymnasium writes bounds that differ as arrays of many lines."""
    line = " ".join(str(space).split())
    return line if len(line) <= _MOST_CHARACTERS else f"{line[:_MOST_CHARACTERS]}..."
