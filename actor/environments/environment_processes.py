"""Environments in separate processes: gymnasium's AsyncVectorEnv with a safe start and end."""

import multiprocessing.connection
import multiprocessing.process
import multiprocessing.resource_tracker
import multiprocessing.spawn
import multiprocessing.util
import os
import signal
import sys
import threading
import time
import weakref
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from functools import partial
from queue import Empty
from typing import Any, SupportsFloat

import gymnasium
import numpy as np
from gymnasium.error import CustomSpaceError
from gymnasium.vector import AsyncVectorEnv, AutoresetMode
from gymnasium.vector.async_vector_env import _async_worker

from daedalus.actor.environments.components import is_text, leaves
from daedalus.actor.environments.environment_errors import (
    EnvironmentSetupError,
    creation_errors,
    hint_of_count,
    playing_error,
)
from daedalus.actor.environments.info import info_to_keep
from daedalus.actor.environments.wrappers import OfItsSpace

_CLOSE_SECONDS = 10.0  # for the environments' own `close`, which may finish a video
_TERMINATE_SECONDS = 1.0  # for a process that handles SIGTERM itself
_DEATH_SECONDS = 2.0  # from the end of a process's pipe to its exit status
_ERROR_SECONDS = 10.0  # from the answer of a process that failed to its error
_UNMADE = 70  # exit status of a process whose environment cannot be made

_PRELOADED = ["daedalus.actor.environments.gymnasium_backend"]

# Python would run the program's main module again in each process: a script without `if __name__ == "__main__":` would
# do all its work once more, and that of standard input cannot be read twice. What a process needs of it is pickled.
_starting = threading.local()  # .without_main: whether this thread starts such processes
_python_preparation_data = multiprocessing.spawn.get_preparation_data


def _preparation_data(name: str) -> dict[str, Any]:
    data = _python_preparation_data(name)
    if getattr(_starting, "without_main", False):
        for key in ("init_main_from_name", "init_main_from_path"):
            data.pop(key, None)
    return data


multiprocessing.spawn.get_preparation_data = _preparation_data

_Stepped = tuple[Any, SupportsFloat, bool, bool, dict[str, Any]]


class OfItsOwnProcess(gymnasium.Wrapper):
    """A wrapper with results that can leave a process: errors without objects of the user, and the `info` that is read.

    gymnasium would wait for ever for an exception that cannot be pickled, and its shared memory cannot hold a text with
    other letters than those of its space. Texts that nobody reads are therefore empty.
    """

    def __init__(self, environment: gymnasium.Env, name: str, left_out: Sequence[str]) -> None:
        """Construct from the environment, its id, and the names of components that nobody reads."""
        super().__init__(environment)
        self._name = name
        self._unread_texts = [
            leaf.path
            for leaf in (leaves(environment.observation_space, "observation") if left_out else ())
            if leaf.name in left_out and is_text(leaf.space)
        ]

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """See gymnasium.Env. Raises EnvironmentSetupError for anything that the environment raises."""
        with self._errors("reset"):
            observation, info = self.env.reset(seed=seed, options=options)
            return self._without_texts(observation), info_to_keep(info, ended=False)

    def step(self, action: Any) -> _Stepped:
        """See gymnasium.Env. Raises EnvironmentSetupError for anything that the environment raises."""
        with self._errors("step"):
            observation, reward, terminated, truncated, info = self.env.step(action)
            ended = bool(terminated or truncated)
            info = info_to_keep(info, ended=ended)
            return self._without_texts(observation), reward, terminated, truncated, info

    def _without_texts(self, observation: Any) -> Any:
        for path in self._unread_texts:
            observation = _emptied(observation, path)
        return observation

    @contextmanager
    def _errors(self, call: str) -> Iterator[None]:
        try:
            yield
        except EnvironmentSetupError as error:
            raise EnvironmentSetupError(str(error)) from None
        except (Exception, SystemExit) as error:  # of the user's code
            raise EnvironmentSetupError(str(playing_error(self._name, call, error))) from None


def _emptied(value: Any, path: tuple[str | int, ...]) -> Any:
    """Return a nested value with an empty text at a path. Parts that do not change are shared."""
    if not path:
        return ""
    key, *rest = path
    part = _emptied(value[key], tuple(rest))
    if isinstance(value, dict):
        return {**value, key: part}
    return tuple(part if index == key else other for index, other in enumerate(value))


@dataclass(frozen=True, slots=True)
class _Maker:
    """A picklable function that creates one environment in a process of its own."""

    name: str
    make: Callable[[], gymnasium.Env]
    left_out: tuple[str, ...]
    parent: int

    def __call__(self) -> gymnasium.Env:
        parent = multiprocessing.parent_process()
        if parent is not None and parent.pid == self.parent:  # else gymnasium has called this maker in the parent
            # Forked processes have the same global generator; some environments use it in place of their own.
            np.random.seed()
            threading.Thread(target=_end_after, args=(parent,), name="parent-watch", daemon=True).start()
        return OfItsOwnProcess(OfItsSpace(self.make(), self.name, self.left_out), self.name, self.left_out)


def _end_after(parent: multiprocessing.process.BaseProcess) -> None:
    """End this process after its parent has died: an environment that hangs would run on for ever."""
    parent.join()
    time.sleep(_CLOSE_SECONDS)  # one that does not hang ends by itself
    os._exit(1)


def _serve(name: str, count: int, index: int, make: Callable[[], gymnasium.Env], *arguments: Any) -> None:
    """Make one environment and serve it, as gymnasium's worker does; or put the reason why it cannot be made.

    Args:
      name: id of the environments, for errors.
      count: number of environments.
      index: of this one.
      make: creates it.
      arguments: the other arguments of a worker of gymnasium.
    """
    _, _, _, errors, *_ = arguments  # pipe, parent_pipe, shared_memory, error_queue
    try:
        with creation_errors(name, hint_of_count(index, count)):
            environment = make()
    except EnvironmentSetupError as error:
        errors.put((index, EnvironmentSetupError, EnvironmentSetupError(str(error)), ""))
        sys.exit(_UNMADE)
    _async_worker(index, lambda: environment, *arguments)


def _kill(processes: Sequence[multiprocessing.process.BaseProcess]) -> None:
    for process in processes:
        process.kill()


class EnvironmentProcesses(AsyncVectorEnv):
    """One process for each environment. SIGINT to the process group does not reach them: their parent ends them."""

    _idle = False  # no call is in progress, so the processes can be asked to end

    def __init__(
        self, name: str, makers: Sequence[Callable[[], gymnasium.Env]], *, left_out: Sequence[str] = ()
    ) -> None:
        """Start the processes.

        Args:
          name: id of the environments, for errors.
          makers: picklable functions, each of which creates one environment.
          left_out: names of components of the observation that nobody reads.

        Raises EnvironmentSetupError if a process dies, and whatever the first environment raises.
        """
        self._name = name
        wrapped = [_Maker(name, maker, tuple(left_out), os.getpid()) for maker in makers]
        with _interrupts_blocked():
            try:
                self._start(wrapped)
            except (EOFError, ConnectionError):
                error = self._death()
                self.close(terminate=True)
                raise error from None
            except BaseException:
                _kill(getattr(self, "processes", ()))
                self.closed = True  # the garbage collector may have closed the pipes before it closes this
                raise
        # The interpreter waits for processes that are no daemons: end those that nobody has closed.
        weakref.finalize(self, _kill, self.processes)
        self._idle = True

    def _start(self, makers: Sequence[_Maker]) -> None:
        options: dict[str, Any] = {
            "context": _start_method(),
            "autoreset_mode": AutoresetMode.NEXT_STEP,
            "worker": partial(_serve, self._name, len(makers)),
            "daemon": False,  # an environment may start processes of its own
        }
        _starting.without_main = True
        try:
            self._start_with(makers, options)
        finally:
            _starting.without_main = False

    def _start_with(self, makers: Sequence[_Maker], options: dict[str, Any]) -> None:
        try:
            super().__init__(makers, **options)
        except (TypeError, ValueError) as error:
            if not isinstance(error.__cause__, CustomSpaceError) and "dynamic shape" not in str(error):
                raise
            # A space of a class of its own, or one such as Sequence: the run may leave it out.
            super().__init__(makers, **options, shared_memory=False)

    def reset(self, *, seed: Any = None, options: dict[str, Any] | None = None) -> Any:
        """See AsyncVectorEnv. Raises EnvironmentSetupError if an environment fails or its process has died."""
        return self._call(lambda: super(EnvironmentProcesses, self).reset(seed=seed, options=options))

    def step(self, actions: Any) -> Any:
        """See AsyncVectorEnv. Raises EnvironmentSetupError if an environment fails or its process has died."""
        return self._call(lambda: super(EnvironmentProcesses, self).step(actions))

    def set_attr(self, name: str, values: Any) -> None:
        """See AsyncVectorEnv. Raises EnvironmentSetupError if a process has died."""
        self._call(lambda: super(EnvironmentProcesses, self).set_attr(name, values))

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
            raise self._death() from None
        self._idle = True
        return result

    def _raise_if_errors(self, successes: Iterable[bool]) -> None:
        """Raise the first error that a process sent. gymnasium would also print the traceback of each."""
        if all(successes):
            return
        try:
            _, _, error, _ = self.error_queue.get(timeout=_ERROR_SECONDS)
        except Empty:
            raise EnvironmentSetupError(
                f"environment {self._name}: the process of an environment has failed, and could not say why"
            ) from None
        raise error

    def _death(self) -> EnvironmentSetupError:
        """Return the error of a process that has died, with its exit status."""
        closed = multiprocessing.connection.wait([process.sentinel for process in self.processes], _DEATH_SECONDS)
        for process in self.processes:
            if process.sentinel in closed:
                process.join(_DEATH_SECONDS)
        status = next((process.exitcode for process in self.processes if process.exitcode is not None), None)
        if status == _UNMADE:
            with suppress(Empty):
                return self.error_queue.get(timeout=_ERROR_SECONDS)[2]
        if status is None:
            hint = ""
        elif status == -getattr(signal, "SIGKILL", 9):
            hint = " (signal 9): check whether it was killed for lack of memory"
        else:
            reason = f"signal {-status}" if status < 0 else f"status {status}"
            hint = f" ({reason}): the environment or one of its libraries ended it; play it with `daedalus check`"
        return EnvironmentSetupError(f"environment {self._name}: the process of an environment has died{hint}")


def _start_method() -> str:
    """Return how processes start, after the start of the server that forks them, if there is one.

    The server is a new interpreter, because Zenoh does not work after a fork. It has imported what all processes need,
    and nothing of the user's: a new interpreter for each process takes several times as long (docs/results.md).
    """
    if sys.platform != "linux":  # Apple's frameworks do not work after a fork
        return "spawn"
    from multiprocessing import forkserver  # Windows may have none

    forkserver.set_forkserver_preload(_PRELOADED)
    try:
        forkserver.ensure_running()
    except OSError:  # such as a folder for temporary files whose path is too long for a socket
        return "spawn"
    return "forkserver"


@contextmanager
def _interrupts_blocked() -> Iterator[None]:
    """Block SIGINT; processes that start meanwhile inherit the block for good."""
    if not hasattr(signal, "pthread_sigmask"):
        yield
        return
    multiprocessing.resource_tracker.ensure_running()  # its start would unblock SIGINT
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
