"""Environments in separate processes: gymnasium's AsyncVectorEnv with a safe start and end."""

import signal
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from typing import Any

import gymnasium
from gymnasium.error import CustomSpaceError
from gymnasium.vector import AsyncVectorEnv, AutoresetMode

from daedalus.actor.environments.environment_errors import EnvironmentSetupError

_CLOSE_SECONDS = 10.0  # for the environments' own `close`, which may finish a video
_TERMINATE_SECONDS = 1.0  # for a process that handles SIGTERM itself


class EnvironmentProcesses(AsyncVectorEnv):
    """One process for each environment. SIGINT to the process group does not reach them: their parent ends them."""

    _idle = False  # no call is in progress, so the processes can be asked to end

    def __init__(self, makers: Sequence[Callable[[], gymnasium.Env]]) -> None:
        # Zenoh does not work after a fork.
        options: dict[str, Any] = {"context": "spawn", "autoreset_mode": AutoresetMode.NEXT_STEP}
        with _interrupts_blocked():
            try:
                super().__init__(makers, **options)
            except ValueError as error:
                if not isinstance(error.__cause__, CustomSpaceError):
                    raise
                super().__init__(makers, **options, shared_memory=False)  # such as a text of a class of its own
        self._idle = True

    def reset(self, *, seed: Any = None, options: dict[str, Any] | None = None) -> Any:
        """See AsyncVectorEnv. Raises EnvironmentSetupError if a process has died."""
        return self._call(lambda: super(EnvironmentProcesses, self).reset(seed=seed, options=options))

    def step(self, actions: Any) -> Any:
        """See AsyncVectorEnv. Raises EnvironmentSetupError if a process has died."""
        return self._call(lambda: super(EnvironmentProcesses, self).step(actions))

    def close_extras(self, timeout: float | None = None, terminate: bool = False) -> None:
        """End the processes: by request if they are idle, then by a signal, then by force.

        Unlike the base class this waits for no answer: a simulator may not return from its `close`.

        Args:
          timeout: seconds that idle processes have to close their environments; None: `_CLOSE_SECONDS`.
          terminate: end them by a signal at once.
        """
        pipes = [pipe for pipe in self.parent_pipes if pipe is not None and not pipe.closed]
        if self._idle and not terminate:
            for pipe in pipes:
                with suppress(OSError):  # its process has died
                    pipe.send(("close", None))
            self._join(_CLOSE_SECONDS if timeout is None else timeout)
        for process in self.processes:
            process.terminate()
        self._join(_TERMINATE_SECONDS)
        for process in self.processes:
            process.kill()
        for process in self.processes:
            process.join()
        for pipe in pipes:
            pipe.close()

    def _join(self, seconds: float) -> None:
        """Wait until all processes have ended, at most so many seconds."""
        deadline = time.monotonic() + seconds
        for process in self.processes:
            process.join(max(deadline - time.monotonic(), 0.0))

    def _call(self, call: Callable[[], Any]) -> Any:
        self._idle = False
        try:
            result = call()
        except (EOFError, ConnectionError):
            if None in self.parent_pipes:  # the environment's own error, sent by its process
                raise
            raise EnvironmentSetupError(
                "the process of an environment has died: check whether it was killed, such as for lack of memory"
            ) from None
        self._idle = True
        return result


@contextmanager
def _interrupts_blocked() -> Iterator[None]:
    """Block SIGINT; processes that start meanwhile inherit the block for good."""
    if not hasattr(signal, "pthread_sigmask"):
        yield
        return
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
