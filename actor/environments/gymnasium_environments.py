"""Environments of a gymnasium vector environment, as the actor steps them."""

import logging
import signal
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager, nullcontext, suppress
from enum import Enum
from functools import partial
from typing import Any

import gymnasium
import numpy as np
from gymnasium.vector import AutoresetMode, SyncVectorEnv

from daedalus.actor.checking.violations import all_flags, observation_violations
from daedalus.actor.environments.components import without
from daedalus.actor.environments.environment_errors import (
    EnvironmentSetupError,
    close_each,
    creation_errors,
    hint_of_count,
    playing_error,
)
from daedalus.actor.environments.environment_processes import EnvironmentProcesses
from daedalus.actor.environments.info import MASK_KEY, EpisodeInfo, info_to_keep, mask_of_one
from daedalus.actor.environments.parameters import wrapper_of
from daedalus.actor.environments.vector_environments import BackendStep
from daedalus.actor.environments.wrappers import OfItsSpace
from daedalus.policy.user_code import first_line, place_of
from daedalus.policy.user_modules import USER_STATE
from daedalus.protocol.lessons import Parameters
from daedalus.protocol.texts import bounded_text, printable

_LONGEST_NAME = 24  # characters of the name of an action
CLOSE_SECONDS = 5.0
_NEXT_SECONDS = 1.0  # for each further environment that does not return


@contextmanager
def limited_close() -> Iterator[None]:
    """Raise TimeoutError in the block after `CLOSE_SECONDS`, and again every second: a simulator may not return.

    What was played would be lost. It works in the main thread of a system that has timers, and does not interrupt
    native code.
    """
    if threading.current_thread() is not threading.main_thread() or not hasattr(signal, "setitimer"):  # Windows
        yield
        return

    def interrupt(_number: int, _frame: object) -> None:
        raise TimeoutError("it does not return")

    handler, began = signal.signal(signal.SIGALRM, interrupt), time.monotonic()
    remaining, interval = signal.setitimer(signal.ITIMER_REAL, CLOSE_SECONDS, _NEXT_SECONDS)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0.0)
        signal.signal(signal.SIGALRM, handler)
        if remaining:  # somebody else's timer goes on
            signal.setitimer(signal.ITIMER_REAL, max(remaining - (time.monotonic() - began), 0.001), interval)


class EnvironmentsInTurn(SyncVectorEnv):
    """A SyncVectorEnv that collects only what an actor reads of `info`: see info_to_keep.

    To collect all entries of every step takes a tenth of the time of MuJoCo's environments.
    """

    def __init__(
        self, name: str, makers: Sequence[Callable[[], gymnasium.Env]], *, left_out: Sequence[str] = ()
    ) -> None:
        """Make the environments. If one cannot be made, close the others: a simulator may outlive this process.

        Args:
          name: id of the environments, for errors.
          makers: functions, each of which creates one environment.
          left_out: names of components of the observation that nobody reads.

        Raises EnvironmentSetupError.
        """
        made: list[gymnasium.Env] = []

        def make(maker: Callable[[], gymnasium.Env]) -> gymnasium.Env:
            with creation_errors(name, hint_of_count(len(made), len(makers))):
                made.append(maker())
                return OfItsSpace(made[-1], name, left_out)

        try:
            super().__init__([partial(make, maker) for maker in makers], autoreset_mode=AutoresetMode.NEXT_STEP)
        except BaseException:
            for environment in made:
                with suppress(Exception, SystemExit):  # of the user's code
                    environment.close()
            raise
        self._collecting = False

    def close_extras(self, **_options: Any) -> None:
        """Close all environments, then raise the first exception that one of them raised."""
        self.closed = True  # also after an exception: the environments would be closed again
        close_each(getattr(self, "envs", ()))  # gymnasium 1.1 closes also what could not be made

    def _add_info(self, vector_infos: dict[str, Any], env_info: dict[str, Any], env_num: int) -> dict[str, Any]:
        if self._collecting:  # the base class calls this method again for a map in `info`
            return super()._add_info(vector_infos, env_info, env_num)
        ended = bool(self._terminations[env_num] or self._truncations[env_num])
        if not ended and MASK_KEY not in env_info:
            return vector_infos
        kept = info_to_keep(env_info, ended=ended)
        self._collecting = True
        try:
            return super()._add_info(vector_infos, kept, env_num)
        finally:
            self._collecting = False


_logger = logging.getLogger(__name__)


class GymnasiumEnvironments:
    """A BackendEnvironments over a gymnasium vector environment."""

    def __init__(self, environment: Any, name: str, leave_out: Sequence[str] = (), *, has_choices: bool = True) -> None:
        """Construct from the vector environment, and reset it if its actions may have masks: only `info` shows them.

        Of environments that are stepped in turn only the first is reset: a reset may be slow.

        Args:
          environment: the vector environment.
          name: its id, for errors.
          leave_out: components of the observation that nobody reads: a value outside their space is no error.
          has_choices: whether some actions are choices, which may have masks.

        Raises EnvironmentSetupError if an environment raises an exception, as `reset` and `step` do, or has no such
        component to leave out.
        """
        self._environment, self._name = environment, name
        self.count: int = environment.num_envs
        self.observation_space: gymnasium.Space = environment.single_observation_space
        self.action_space: gymnasium.Space = environment.single_action_space
        self._read_space = without(self.observation_space, leave_out)
        self._lengths = np.zeros(self.count, np.int64)  # of the running episodes
        self._ended = np.zeros(self.count, np.bool_)  # whose next step only resets
        self._episode_info = EpisodeInfo()
        self._parameters: dict[int, Parameters] = {}  # of environments in processes
        # Environments that gymnasium steps one by one enter it themselves, so that the batch is made under ours.
        one_by_one = isinstance(environment, SyncVectorEnv | EnvironmentProcesses)
        self._user_state: Callable[[], AbstractContextManager[None]] = (
            USER_STATE.watched if one_by_one else lambda: USER_STATE
        )
        # Wrappers truncate the episodes of single environments; a vector entry point has been given the limit.
        self._limit: int | None = None if one_by_one else environment.unwrapped.spec.kwargs.get("max_episode_steps")
        self.action_mask: Any = None
        if not has_choices:
            return
        if isinstance(environment, SyncVectorEnv):
            self.action_mask = self._first_mask(environment)
        else:
            self.reset(0)

    def reset(self, seed: int) -> Any:
        """See BackendEnvironments."""
        try:
            with self._user_state():
                observations, info = self._environment.reset(seed=seed)
        except EnvironmentSetupError:
            raise
        except (Exception, SystemExit) as error:  # of the user's code
            raise self._failure("reset", error) from error
        self.action_mask = self._checked_info("reset", info).get(MASK_KEY)
        self._lengths[:], self._ended = 0, np.zeros(self.count, np.bool_)
        return observations

    def set_parameters(self, parameters: Mapping[int, Parameters]) -> None:
        """Set what some of the environments, by their index, begin their next episodes with, in place of the true task.

        The specification has `parameters`, with the same names. Raises EnvironmentSetupError if a process has died.
        """
        if isinstance(self._environment, SyncVectorEnv):
            for index, each in parameters.items():
                wrapper_of(self._environment.envs[index]).next_parameters = each
            return
        self._parameters |= parameters
        self._environment.set_attr("next_parameters", [self._parameters.get(each, {}) for each in range(self.count)])

    def step(self, actions: Any) -> BackendStep:
        """See BackendEnvironments."""
        try:
            with self._user_state():
                observations, rewards, terminated, truncated, info = self._environment.step(actions)
        except EnvironmentSetupError:
            raise
        except (Exception, SystemExit) as error:  # of the user's code
            raise self._failure("step", error) from error
        self.action_mask = self._checked_info("step", info).get(MASK_KEY)
        rewards = self._one_each("rewards", rewards, np.float64)
        terminated = self._one_each("terminated", terminated, np.bool_)
        truncated = self._one_each("truncated", truncated, np.bool_)
        if info:
            self._episode_info.add(info, terminated | truncated)
        if self._limit is not None:
            self._check_lengths(self._limit, terminated | truncated)
        return observations, rewards, terminated, truncated

    def _check_lengths(self, limit: int, ended: np.ndarray) -> None:
        """Raise EnvironmentSetupError if an episode goes on at the limit: the environment has ignored it."""
        self._lengths = np.where(self._ended, 0, self._lengths + 1)
        self._ended = ended
        if np.count_nonzero((self._lengths >= limit) & ~ended):
            raise EnvironmentSetupError(
                f"environment {self._name}: its vector entry point has got max_episode_steps={limit}, but an episode "
                f"goes on after {limit:,} steps: return truncated there"
            )

    def _checked_info(self, call: str, info: Any) -> dict[str, Any]:
        if not isinstance(info, dict):
            raise EnvironmentSetupError(
                f"environment {self._name}: {call} returns info of type {type(info).__name__}: it must be a dict"
            )
        return info

    def _one_each(self, what: str, values: Any, dtype: type) -> np.ndarray:
        """Return one value of each environment [E]; `values` may have further axes of size 1."""
        try:
            array = np.asarray(values, dtype)
        except (TypeError, ValueError):
            array = np.zeros(0)
        if dtype is np.bool_ and not all_flags(values, self.count):  # a text such as "False" would be true
            array = np.zeros(0)
        if array.shape == (self.count,):
            return array
        if array.size != self.count:
            raise EnvironmentSetupError(
                f"environment {self._name}: step returns {what} of shape {np.shape(values)}, but it must be one "
                f"{'number' if dtype is np.float64 else 'bool'} for each of the {self.count} environments"
            )
        return array.reshape(self.count)

    def _first_mask(self, environment: SyncVectorEnv) -> Any:
        """Reset the first environment, and return its mask with a first axis of 1, or None without masks."""
        try:
            mask = environment.envs[0].reset(seed=0)[1].get(MASK_KEY)
            return None if mask is None else mask_of_one(mask)
        except EnvironmentSetupError:
            raise
        except (Exception, SystemExit) as error:  # of the user's code
            raise self._failure("reset", error) from error

    def _failure(self, call: str, error: BaseException) -> EnvironmentSetupError:
        """Return the error of a call. It names an observation that is not of its space.

        gymnasium only fails to copy such an observation into the batch.
        """
        if isinstance(error, (KeyError, IndexError, TypeError, ValueError)):
            for observation in getattr(self._environment, "_env_obs", ()):  # of SyncVectorEnv
                if observation is None:
                    continue
                for kind, text in observation_violations(self._read_space, observation, "a step or a reset"):
                    if kind == "problem":
                        return EnvironmentSetupError(f"environment {self._name}: {text}")
        return playing_error(self._name, call, error)

    @property
    def action_names(self) -> tuple[str, ...]:
        """What the environment calls its choices, by a convention of Atari or of MiniGrid; empty if it does not say."""
        first = self._environment.envs[0] if isinstance(self._environment, SyncVectorEnv) else None
        names: Any = ()
        with suppress(Exception, SystemExit):  # of the user's code
            if first is not None and first.has_wrapper_attr("get_action_meanings"):
                names = first.get_wrapper_attr("get_action_meanings")()
            elif first is not None and isinstance(actions := getattr(first.unwrapped, "actions", None), type(Enum)):
                names = [action.name for action in actions]
        return tuple(bounded_text(printable(str(name)), _LONGEST_NAME) for name in names)

    def take_episode_info(self) -> dict[str, np.ndarray]:
        """See BackendEnvironments."""
        return self._episode_info.take()

    def close(self) -> None:
        """See BackendEnvironments. An exception of an environment is only logged: it has done its work."""
        try:
            # Environments in processes have a limit of their own, which ends these.
            with USER_STATE, nullcontext() if isinstance(self._environment, EnvironmentProcesses) else limited_close():
                self._environment.close()
        except (Exception, SystemExit) as error:  # of the user's code
            _logger.warning("environment %s: close raises %s%s", self._name, first_line(error), place_of(error))
