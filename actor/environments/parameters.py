"""Parameters of a gymnasium environment, set before each episode: by its own method or as options of its reset."""

import difflib
import inspect
from collections.abc import Callable, Iterator
from contextlib import suppress
from typing import Any

import gymnasium

from daedalus.actor.environments.environment_errors import EnvironmentSetupError
from daedalus.policy.user_code import first_line, place_of, print_traceback
from daedalus.protocol.lessons import Parameters
from daedalus.protocol.texts import exact_number

_METHOD = "set_parameters"  # of an environment or a wrapper: set_parameters(gravity=9.8)


class ReadOptions(dict[str, Any]):
    """Options of a reset that note which of them are read."""

    def __init__(self, options: dict[str, Any]) -> None:
        super().__init__(options)
        self.read: set[str] = set()

    def __getitem__(self, name: str) -> Any:
        self.read.add(name)
        return super().__getitem__(name)

    def __contains__(self, name: object) -> bool:
        self.read.add(str(name))
        return super().__contains__(name)

    def get(self, name: str, default: Any = None) -> Any:
        """See dict."""
        self.read.add(name)
        return super().get(name, default)

    def pop(self, name: str, *default: Any) -> Any:
        """See dict."""
        self.read.add(name)
        return super().pop(name, *default)

    def setdefault(self, name: str, default: Any = None) -> Any:
        """See dict."""
        self.read.add(name)
        return super().setdefault(name, default)

    def __iter__(self) -> Iterator[str]:
        self.read.update(super().keys())  # whoever has all names may read each
        return super().__iter__()

    def keys(self) -> Any:
        """See dict."""
        self.read.update(super().keys())
        return super().keys()

    def items(self) -> Any:
        """See dict."""
        self.read.update(super().keys())
        return super().items()

    def values(self) -> Any:
        """See dict."""
        self.read.update(super().keys())
        return super().values()

    def copy(self) -> dict[str, Any]:
        """See dict."""
        return dict(self)

    def __or__(self, other: Any) -> Any:
        return dict(self) | other


class WithParameters(gymnasium.Wrapper):
    """A wrapper that sets parameters before each episode, and refuses those that the environment does not have.

    Attributes:
      next_parameters: those of the next episode. Whoever changes them replaces the map.
    """

    def __init__(self, environment: gymnasium.Env, name: str, parameters: Parameters) -> None:
        """Construct from the environment, its id, and the parameters of the true task.

        Raises EnvironmentSetupError for one that the environment's method does not take.
        """
        super().__init__(environment)
        self._name = name
        self.next_parameters: Parameters = parameters
        self._true = parameters
        self._set: Parameters = {}  # as they are now
        self._first = True  # whether no reset has succeeded yet
        has_method = environment.has_wrapper_attr(_METHOD)
        self._method: Callable[..., object] | None = environment.get_wrapper_attr(_METHOD) if has_method else None
        taken = None if self._method is None else _arguments(self._method)
        for unknown in () if taken is None else (each for each in parameters if each not in taken):
            raise self._unknown(unknown, taken or (), f"its {_METHOD} takes {', '.join(taken or ()) or 'none'}")

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """See gymnasium.Env. Raises EnvironmentSetupError for parameters that the environment refuses."""
        given, method = self.next_parameters, self._method
        shown = ", ".join(f"{name}={exact_number(value)}" for name, value in given.items())
        if method is not None:
            # Also with values that have not changed: an episode may have changed them.
            self._call(f"{_METHOD}({shown})", given, lambda: method(**given))
            self._set = given
            return self.env.reset(seed=seed, options=options)
        all_options: dict[str, Any] = {**(options or {}), **given}
        if given == self._set:
            return self.env.reset(seed=seed, options=all_options)
        noted = ReadOptions(all_options) if self._first else all_options
        result = self._call(f"reset with the options {shown}", given, lambda: self.env.reset(seed=seed, options=noted))
        if isinstance(noted, ReadOptions):
            for unread in (name for name in given if name not in noted.read):
                others = sorted(noted.read)
                found = f"reset reads {', '.join(others)} of its options" if others else "reset reads no option"
                raise self._unknown(unread, others, f"{found}, and the environment has no method {_METHOD}")
        self._set, self._first = given, False
        return result

    def _call(self, what: str, given: Parameters, call: Callable[[], Any]) -> Any:
        try:
            return call()
        except EnvironmentSetupError:
            raise
        except (Exception, SystemExit) as error:  # of the user's code
            changed = next((name for name, value in given.items() if self._set.get(name) != value), next(iter(given)))
            print_traceback(error)
            section = "environment.parameters" if given[changed] == self._true.get(changed) else "lessons"
            remedy = f"if it refuses a value, change {section}.{changed}"
            if isinstance(error, TypeError) and "'options'" in str(error):
                remedy = f"give its reset the argument options, or give it a method {_METHOD}"
            raise EnvironmentSetupError(
                f"environment {self._name}: {what} raises {first_line(error)}{place_of(error)}: {remedy}"
            ) from None

    def _unknown(self, name: str, known: Any, reason: str) -> EnvironmentSetupError:
        near = difflib.get_close_matches(name, known, 1)
        hint = f"did you mean {near[0]}?" if near else "correct environment.parameters and [lessons]"
        return EnvironmentSetupError(f"environment {self._name} has no parameter {name}: {reason}; {hint}")


def _arguments(method: Callable[..., object]) -> tuple[str, ...] | None:
    """Return the names that a method takes as keywords; None if it takes any, or they are not known."""
    with suppress(TypeError, ValueError):
        parameters = inspect.signature(method).parameters.values()
        if any(each.kind is inspect.Parameter.VAR_KEYWORD for each in parameters):
            return None
        keywords = (inspect.Parameter.POSITIONAL_OR_KEYWORD, inspect.Parameter.KEYWORD_ONLY)
        return tuple(each.name for each in parameters if each.kind in keywords)
    return None


def wrapper_of(environment: gymnasium.Env) -> WithParameters:
    """Return the wrapper that sets the parameters of an environment, which has one."""
    while not isinstance(environment, WithParameters):
        assert isinstance(environment, gymnasium.Wrapper)
        environment = environment.env
    return environment
