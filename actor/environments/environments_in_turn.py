"""Environments of this process, stepped one after the other: gymnasium's SyncVectorEnv for actors."""

from collections.abc import Callable, Sequence
from contextlib import suppress
from functools import partial
from typing import Any

import gymnasium
from gymnasium.vector import AutoresetMode, SyncVectorEnv

from daedalus.actor.environments.environment_errors import creation_errors, hint_of_count
from daedalus.actor.environments.episode_info import info_to_keep
from daedalus.actor.environments.masks import MASK_KEY
from daedalus.actor.environments.wrappers import OfItsSpace


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
        errors: list[BaseException] = []
        for environment in self.envs:
            try:
                environment.close()
            except (Exception, SystemExit) as error:  # of the user's code
                errors.append(error)
        if errors:
            raise errors[0]

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
