"""Environments that only a Python program has: it gives them to this process, or this process is a fork of it."""

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from contextvars import ContextVar
from types import MappingProxyType
from typing import Any

import gymnasium
from gymnasium.envs.registration import EnvSpec

from daedalus.actor.environments.environment_errors import EnvironmentSetupError
from daedalus.protocol.spec import FROM_PYTHON

Maker = Callable[..., gymnasium.Env]  # a class, or a function that returns an environment

_NONE: Mapping[str, Maker] = MappingProxyType({})
_given: ContextVar[Mapping[str, Maker]] = ContextVar("given", default=_NONE)  # by the id of the environment


@contextmanager
def giving(environment_id: str, maker: Maker) -> Iterator[None]:
    """Let this thread, and forks that it makes in the block, make an environment by an id that no module has."""
    before = _given.set({**_given.get(), environment_id: maker})
    try:
        yield
    finally:
        _given.reset(before)


def given_environment(environment_id: str) -> EnvSpec:
    """Return the registration of an environment that was given to this thread. Raises EnvironmentSetupError."""
    maker = _given.get().get(environment_id)
    if maker is None:
        raise EnvironmentSetupError(
            f"environment {environment_id} is an object of the Python program that started the run, and no module has "
            "it: pass it again, with daedalus.resume(RUN_DIR, env=...) or daedalus.evaluate(RUN_DIR, env=...)"
        )
    return EnvSpec(id=environment_id.removeprefix(FROM_PYTHON), entry_point=maker)


class OneInstance:
    """The maker of an environment that exists already. One at a time may have it, and nobody closes it."""

    def __init__(self, environment: gymnasium.Env) -> None:
        self._environment, self._is_lent = environment, False

    def __call__(self, **kwargs: Any) -> gymnasium.Env:
        """Return the environment. Raises EnvironmentSetupError."""
        kind = type(self._environment.unwrapped).__name__
        if kwargs:
            raise EnvironmentSetupError(
                f"{kind} is an instance, so it takes no arguments ({', '.join(kwargs)}): leave them out, or pass its "
                "class or a function in its place"
            )
        if self._is_lent:
            raise EnvironmentSetupError(
                f"{kind} is one instance, so only one environment can be played at a time: pass its class or a "
                "function in its place"
            )
        self._is_lent = True
        return _Lent(self._environment, self._take_back)

    def _take_back(self) -> None:
        self._is_lent = False


class _Lent(gymnasium.Wrapper):
    """An environment of the program: it stays open, and has its own `spec` again, when it is closed here."""

    def __init__(self, environment: gymnasium.Env, on_close: Callable[[], None]) -> None:
        super().__init__(environment)
        self._spec, self._on_close = environment.unwrapped.spec, on_close

    def close(self) -> None:
        """Give the environment back."""
        self.unwrapped.spec = self._spec
        self._on_close()
