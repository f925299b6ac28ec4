"""Action tables: discrete choices over a continuous action space."""

import gymnasium
import numpy as np

from daedalus.actor.environments.environment_errors import EnvironmentSetupError, described


def table_actions(table: tuple[tuple[float, ...], ...], space: gymnasium.Space) -> np.ndarray:
    """Return the environment's action for each row of the table, [count, *action_shape].

    Raises EnvironmentSetupError if the table does not fit the space.
    """
    if not isinstance(space, gymnasium.spaces.Box):
        raise EnvironmentSetupError(
            f"environment.action_table has {len(table)} rows, but action space {described(space)} needs no table: "
            "leave it out"
        )
    return _checked(table, space)


def _checked(table: tuple[tuple[float, ...], ...], space: gymnasium.spaces.Box) -> np.ndarray:
    for number, row in enumerate(table):
        if len(row) != _size(space):
            raise EnvironmentSetupError(
                f"environment.action_table row {number} has {len(row)} numbers, "
                f"but an action of space {described(space)} has {_size(space)}"
            )
        action = np.asarray(row, space.dtype)
        if not ((action >= space.low.ravel()) & (action <= space.high.ravel())).all():
            raise EnvironmentSetupError(
                f"environment.action_table row {number} is {row}, outside action space {described(space)}"
            )
    return np.asarray(table, space.dtype).reshape(len(table), *space.shape)


def _size(space: gymnasium.spaces.Box) -> int:
    return int(np.prod(space.shape))
