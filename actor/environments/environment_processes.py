"""Environments in processes of their own: gymnasium's AsyncVectorEnv, made to start and end without accidents."""

import signal
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any

import gymnasium
from gymnasium.vector import AsyncVectorEnv, AutoresetMode

from daedalus.actor.environments.environment_errors import EnvironmentSetupError


class EnvironmentProcesses(AsyncVectorEnv):
    """One process for each environment; an interrupt of the process group leaves them to their parent."""

    _answered = False  # whether nothing is under way, so that they can be asked to end themselves

    def __init__(self, makers: Sequence[Callable[[], gymnasium.Env]]) -> None:
        with _interrupts_held():
            super().__init__(
                makers,
                context="spawn",  # Zenoh does not survive a fork
                autoreset_mode=AutoresetMode.NEXT_STEP,
            )
        self._answered = True

    def reset(self, *, seed: Any = None, options: dict[str, Any] | None = None) -> Any:
        """See gymnasium's. Raises EnvironmentSetupError if a process has ended by itself."""
        return self._ask(lambda: super(EnvironmentProcesses, self).reset(seed=seed, options=options))

    def step(self, actions: Any) -> Any:
        """See gymnasium's. Raises EnvironmentSetupError if a process has ended by itself."""
        return self._ask(lambda: super(EnvironmentProcesses, self).step(actions))

    def close_extras(self, timeout: float | None = None, terminate: bool = False) -> None:
        """Ends them: by themselves if they listen, else by a signal. An interrupted step leaves nobody listening."""
        try:
            if self._answered and not terminate:
                super().close_extras(timeout)
        except (EOFError, OSError):
            pass  # one has ended before; the others are ended below
        finally:
            for process in self.processes:
                process.terminate()
            for process in self.processes:
                process.join()

    def _ask(self, question: Callable[[], Any]) -> Any:
        self._answered = False
        try:
            answer = question()
        except (EOFError, ConnectionError):
            if None in self.parent_pipes:  # the environment's own error, which its process has sent
                raise
            raise EnvironmentSetupError("the process of an environment has ended by itself: was it killed?") from None
        self._answered = True
        return answer


@contextmanager
def _interrupts_held() -> Iterator[None]:
    """Holds SIGINT back; processes started meanwhile never see it, since they inherit that."""
    if not hasattr(signal, "pthread_sigmask"):
        yield
        return
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
