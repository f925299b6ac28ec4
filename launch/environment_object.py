"""The `env` of `daedalus.train`: a name, or a class, function or instance of the calling program."""

import functools
import re
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from daedalus.launch.child_output import Streams
from daedalus.launch.forked_process import ForkedProcess, open_descriptors, why_not_forked
from daedalus.launch.supervision import StartPlayer, start
from daedalus.policy.user_modules import module_of, object_of
from daedalus.protocol.spec import FROM_PYTHON

_FIND_SECONDS = 60.0
_MOST_CHARACTERS = 200  # of an environment's id
_FIND = (
    "import importlib.util, os, sys; sys.path.append(os.getcwd()); found = importlib.util.find_spec(sys.argv[1]); "
    "print((found and found.origin) or '')"
)


@dataclass(frozen=True, slots=True, kw_only=True)
class EnvironmentObject:
    """An environment as a user named it, or passed it in Python."""

    id: str | None = None  # for `environment.id`; None: there is none
    maker: Any = None  # what makes it, if no new process can import it
    is_instance: bool = False

    @property
    def modules(self) -> frozenset[str]:
        """The module that the environment names."""
        named = self.id is not None and self.maker is None and ":" in self.id
        return frozenset({module_of(self.id or "")} if named else ())

    def is_for(self, environment_id: str) -> bool:
        """Return whether this may be the environment of a run, as which object its id says no more than a name."""
        if self.maker is not None:
            return environment_id.startswith(FROM_PYTHON)
        return self.id in (None, environment_id)

    @contextmanager
    def players(self, environment_id: str | None = None) -> Iterator[StartPlayer]:
        """Yield what starts the processes that play this environment: forks, if no new process can import it.

        `environment_id` is that of the run, if it exists already. Raises SettingsError if this process cannot fork.
        """
        if self.maker is None:
            yield start
            return
        from daedalus.actor.environments.given_environment import giving  # gymnasium, which other runs do not need

        environment_id = environment_id or self.id
        assert environment_id is not None
        if reason := why_not_forked():
            from daedalus.learner.run.settings import SettingsError  # which an evaluation does not need

            raise SettingsError(
                f"env: no new process can import {environment_id.removeprefix(FROM_PYTHON)}, and {reason}: move it to "
                "a module, a file of its own, and pass the class or function of that module"
            )
        with giving(environment_id, self.maker):
            yield partial(_start_fork, frozenset(open_descriptors()))


def _start_fork(
    keep: frozenset[int], module: str, *arguments: str, streams: Streams, one_thread: bool = False
) -> ForkedProcess:
    """Start a player. It has one thread in any case: its environment was imported before."""
    return ForkedProcess(module, arguments, streams, keep)


NO_ENVIRONMENT = EnvironmentObject()


def environment_object(env: object) -> EnvironmentObject:
    """Return what a user passed as `env`. Raises TypeError if it is no environment."""
    if env is None or isinstance(env, str):
        return EnvironmentObject(id=env)
    import gymnasium
    from gymnasium.vector import VectorEnv

    from daedalus.actor.environments.given_environment import OneInstance

    if isinstance(env, gymnasium.Env):
        name = type(env.unwrapped).__name__
        return EnvironmentObject(id=_own_id(name), maker=OneInstance(env), is_instance=True)
    if isinstance(env, VectorEnv) or (isinstance(env, type) and issubclass(env, VectorEnv)):
        raise TypeError(f"env is {env}, several environments in one: pass the class or function of a single one")
    if not callable(env) or (isinstance(env, type) and not hasattr(env, "step")):
        raise TypeError(
            'env must be the id of a registered environment, such as "CartPole-v1", or a gymnasium.Env: its class, a '
            f"function that returns one, or an instance; not {env}. Of a game of PettingZoo's pass the class, or a "
            "function of a module that returns one, with settings={'environment.backend': 'pettingzoo'}"
        )
    if (importable := _entry_point(env)) is not None:
        return EnvironmentObject(id=importable)
    made = env.func if isinstance(env, functools.partial) else env
    return EnvironmentObject(id=_own_id(getattr(made, "__name__", type(made).__name__)), maker=env)


def _own_id(name: str) -> str:
    return FROM_PYTHON + (re.sub(r"\W", "", name)[:100] or "environment")


def _entry_point(env: Any) -> str | None:
    """Return `module:name` of a class or function if a new process finds it there, else None."""
    import gymnasium

    name, qualified = getattr(env, "__module__", None), getattr(env, "__qualname__", None)
    if not isinstance(name, str) or not isinstance(qualified, str) or name == "__main__":
        return None
    module = sys.modules.get(name)
    file = getattr(module, "__file__", None)
    if module is None or file is None or object_of(module, qualified) is not env or qualified in gymnasium.registry:
        return None
    entry_point = f"{name}:{qualified}"
    return entry_point if len(entry_point) <= _MOST_CHARACTERS and _is_found_again(name, file) else None


def _is_found_again(module: str, file: str) -> bool:
    """Return whether a new process would import a module from the same file. It only looks for the module."""
    with suppress(subprocess.SubprocessError, OSError):
        found = subprocess.run(
            [sys.executable, "-P", "-c", _FIND, module],
            stdin=subprocess.DEVNULL,
            capture_output=True,
            timeout=_FIND_SECONDS,
            check=True,
            text=True,
        ).stdout.splitlines()
        return bool(found and found[-1]) and Path(found[-1]).resolve() == Path(file).resolve()
    return False
