"""Errors of environments that cannot be created or played, each with a message of one line that says what to do."""

import difflib
import importlib
from collections.abc import Collection, Iterable, Iterator
from contextlib import contextmanager
from types import ModuleType
from typing import Any

import gymnasium
from gymnasium.envs.registration import EnvSpec
from pydantic import ValidationError

from daedalus.policy.user_code import first_line, frames_of, is_of_user, place_of, print_traceback
from daedalus.policy.user_modules import USER_STATE, MissingModuleError, UserModuleError, file_of, hidden_file

_FLATTEN = ", or make one array of them: --wrap gymnasium.wrappers:FlattenObservation"
OTHER_BACKEND = "or use another backend (--set environment.backend=gymnasium)"
_MOST_CHARACTERS = 160  # of a space in a message
_MOST_NAMES = 5  # of environments in a message
_CLOSE = 0.7  # similarity of two names that could be meant for each other


class EnvironmentSetupError(Exception):
    """The environment cannot be created or stepped; the message says why and what to do."""


class MissingPackageError(EnvironmentSetupError):
    """A package or module of the environment is not here; the message names it."""


def of_module(error: UserModuleError) -> EnvironmentSetupError:
    """Return the error of an environment whose module cannot be imported."""
    kind = MissingPackageError if isinstance(error, MissingModuleError) else EnvironmentSetupError
    return kind(str(error))


def reason_of(error: ValidationError) -> str:
    """Return why a space is not supported, in words."""
    first = error.errors()[0]
    if first["type"] == "less_than_equal":  # the count of a discrete variable
        return f"{first['input']:,} choices of one variable: use at most {first.get('ctx', {}).get('le'):,}"
    if first["type"] == "too_long" and first["loc"] in (("observations",), ("actions",)):
        part, remedy = ("action", "") if first["loc"] == ("actions",) else ("observation", _FLATTEN)
        most = first.get("ctx", {}).get("max_length")
        return f"the {part} has {len(first['input'])} components: use at most {most}{remedy}"
    return first["msg"].removeprefix("Value error, ")


def unknown_environment(name: str, known: Collection[str], otherwise: str) -> EnvironmentSetupError:
    """Return an error that suggests the known names closest to `name`, or says `otherwise` if none is close."""
    return EnvironmentSetupError(f"unknown environment {name!r}: {_suggestion(name, known) or otherwise}")


def unknown_to_gymnasium(name: str) -> EnvironmentSetupError:
    """Return the error for an id without a module that nothing has registered."""
    own = f"if it is your own, write module:{name}, with the module that registers it"
    near = _suggestion(name, gymnasium.registry)
    return EnvironmentSetupError(f"unknown environment {name!r}: {f'{near} Or, {own}' if near else own}")


def not_registered(name: str, module: ModuleType) -> EnvironmentSetupError:
    """Return the error for a module that registers no environment `name`; it suggests one that the module registers."""
    prefix = f"{module.__name__}:"
    own = [each.id for each in gymnasium.registry.values() if _is_of(each, module.__name__)]
    few = f"it registers {', '.join(prefix + each for each in own[:_MOST_NAMES])}" if own else ""
    hint = _suggestion(name, own, prefix) or few + (" and others" if len(own) > _MOST_NAMES else "")
    return EnvironmentSetupError(
        f"unknown environment {prefix + name!r}: {file_of(module)} registers no {name}, and has no class or "
        f"function of this name{'; ' if hint else ''}{hint}"
        f"{hidden_file(module)}"
    )


def _is_of(registered: EnvSpec, module: str) -> bool:
    """Return whether the class of a registered environment lies in a module."""
    entry = registered.entry_point
    place = entry.partition(":")[0] if isinstance(entry, str) else getattr(entry, "__module__", "")
    return f"{place}.".startswith(f"{module}.")


def _suggestion(name: str, known: Collection[str], prefix: str = "") -> str:
    """Return a question that names the known names closest to `name`, with a prefix, or an empty string."""
    by_lower = {each.lower(): each for each in known}
    near = difflib.get_close_matches(name.lower(), by_lower, 3, _CLOSE)
    return f"did you mean {' or '.join(prefix + by_lower[each] for each in near)}?" if near else ""


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
        raise MissingPackageError(
            f'{purpose} needs a package that is not installed ({error}): pip install "daedalus-rl[{extra}]"'
            f"{', ' if otherwise else ''}{otherwise}"
        ) from None


def raise_problem(whose: str, violations: Iterable[tuple[str, str]]) -> None:
    """Raise EnvironmentSetupError for the first problem among violations (actor/checking/violations.py), if any."""
    for kind, text in violations:
        if kind == "problem":
            raise EnvironmentSetupError(f"{whose}: {text}")


def hint_of_count(made: int, count: int) -> str:
    """Return what may be wrong where an environment cannot be made, but `made` others of `count` could."""
    if not made:
        return ""
    return (
        f" (environment {made + 1} of {count} of this process: if only one can run at a time, use "
        "--set collection.envs_per_actor=1 --actors 1)"
    )


@contextmanager
def creation_errors(environment: str, hint: str = "") -> Iterator[None]:
    """Raise EnvironmentSetupError for anything that the constructor of an environment raises; `hint` ends its message.

    An EnvironmentSetupError passes as it is.
    """
    try:
        with USER_STATE.undone():
            yield
    except EnvironmentSetupError:
        raise
    except gymnasium.error.DependencyNotInstalled as error:
        extra = next((extra for extra in ("box2d", "mujoco") if extra in str(error).lower()), None)
        remedy = first_line(error) if extra is None else f'pip install "daedalus-rl[{extra}]"'
        raise MissingPackageError(
            f"environment {environment} needs a package that is not installed: {remedy}"
        ) from None
    except (Exception, SystemExit) as error:  # broad: the constructor of a user's environment may raise anything
        print_traceback(error)
        raise EnvironmentSetupError(
            f"environment {environment} cannot be created: {first_line(error)}{place_of(error)}{hint}"
        ) from error


def playing_error(environment: str, call: str, error: BaseException) -> EnvironmentSetupError:
    """Return the error, of one line, for an exception that an environment raised while it played. Print its traceback.

    Args:
      environment: its id.
      call: the method that was called, `reset` or `step`. A vector environment resets in its `step`, too.
      error: the exception, caught where the call was made.
    """
    for frame in frames_of(error):
        if frame.tb_frame.f_code.co_name in ("reset", "step"):
            call = frame.tb_frame.f_code.co_name
        if is_of_user(frame):
            break
    print_traceback(error)
    return EnvironmentSetupError(f"environment {environment}: {call} raises {first_line(error)}{place_of(error)}")


def close_each(environments: Iterable[Any]) -> None:
    """Close environments, then raise the first exception that one of them raised."""
    errors: list[BaseException] = []
    for environment in environments:
        try:
            environment.close()
        except (Exception, SystemExit) as error:  # of the user's code
            errors.append(error)
    if errors:
        raise errors[0]


def described(space: object) -> str:
    """Return a space in one short line: gymnasium writes bounds that differ as arrays of many lines."""
    line = " ".join(str(space).split())
    return line if len(line) <= _MOST_CHARACTERS else f"{line[:_MOST_CHARACTERS]}..."
