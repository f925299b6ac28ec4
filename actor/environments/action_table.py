"""Action indices, counted from 0, mapped to the environment's own actions."""

import gymnasium
import numpy as np

from daedalus.actor.environments.environment_errors import EnvironmentSetupError


def env_actions(table: tuple[tuple[float, ...], ...] | None, space: gymnasium.Space) -> np.ndarray:
    """Return the environment's own action for each action index, [count, *action_shape].

    Args:
      table: over a Box, a row of numbers for each action; None for a Discrete space.
      space: the action space of one environment.

    Raises EnvironmentSetupError if the table does not fit the space.
    """
    if isinstance(space, gymnasium.spaces.Discrete):
        if table is not None:
            raise EnvironmentSetupError(
                f"environment.action_table has {len(table)} rows, but action space {space} needs no table: leave it out"
            )
        return np.arange(space.start, space.start + space.n)
    if not isinstance(space, gymnasium.spaces.Box):
        raise EnvironmentSetupError(
            f"action space {space} is not supported: it must be Discrete, or a Box with an environment.action_table"
        )
    if table is None:
        raise EnvironmentSetupError(
            f"action space {space} is not supported without a table: it must be Discrete; "
            f"list the actions to choose from in environment.action_table, {_size(space)} numbers each"
        )
    return _checked(table, space)


def _checked(table: tuple[tuple[float, ...], ...], space: gymnasium.spaces.Box) -> np.ndarray:
    for number, row in enumerate(table):
        if len(row) != _size(space):
            raise EnvironmentSetupError(
                f"environment.action_table row {number} has {len(row)} numbers, "
                f"but an action of space {space} has {_size(space)}"
            )
        action = np.asarray(row, space.dtype)
        if not ((action >= space.low.ravel()) & (action <= space.high.ravel())).all():
            raise EnvironmentSetupError(f"environment.action_table row {number} is {row}, outside action space {space}")
    return np.asarray(table, space.dtype).reshape(len(table), *space.shape)


def _size(space: gymnasium.spaces.Box) -> int:
    return int(np.prod(space.shape))
