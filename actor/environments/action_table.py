"""Action tables: discrete choices over all numbers of a continuous action, or over some of them."""

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import gymnasium
import numpy as np

from daedalus.actor.environments.components import BoundedActions, continuous_space, exported_dtype
from daedalus.actor.environments.environment_errors import EnvironmentSetupError, described
from daedalus.protocol.spaces import ActionSpace, DiscreteSpace

if TYPE_CHECKING:
    from daedalus.policy.saving.onnx_graph import OnnxGraph

_CHOICE, _REST = "table", "continuous"  # components of an action of which the table gives a part


class TableActions:
    """The actions of a Box by an action table: a choice of a row, and the numbers that the table leaves to the policy.

    With a table over all numbers the run has one discrete action, `action`. Else it has two components: `table`, the
    row, and `continuous`, the other numbers in their order.
    """

    def __init__(
        self, table: tuple[tuple[float, ...], ...], columns: tuple[int, ...] | None, space: gymnasium.Space
    ) -> None:
        """Construct the mapping.

        Args:
          table: one row of numbers for each choice.
          columns: which numbers of the flattened action a row gives; None: all, in their order.
          space: of the environment's actions.

        Raises EnvironmentSetupError if the table does not fit the space.
        """
        if not isinstance(space, gymnasium.spaces.Box):
            raise EnvironmentSetupError(
                f"environment.action_table has {len(table)} rows, but action space {described(space)} needs no table: "
                "leave it out"
            )
        size = int(np.prod(space.shape))
        self._columns = np.arange(size) if columns is None else _checked_columns(columns, space, size)
        self._rest = np.setdiff1d(np.arange(size), self._columns)
        self._table = _checked_table(table, self._columns, space)
        self._space = space
        rest_space = gymnasium.spaces.Box(
            space.low.ravel()[self._rest],
            space.high.ravel()[self._rest],
            dtype=space.dtype,  # pyright: ignore[reportArgumentType]  # gymnasium's annotation lacks np.dtype
        )
        self._rest_actions = BoundedActions(rest_space)
        choice = DiscreteSpace(counts=(len(table),))
        self.spaces: dict[str, ActionSpace] = {"action": choice}
        if self._rest.size:
            self.spaces = {_REST: continuous_space(rest_space), _CHOICE: choice}

    def env_actions(self, values: dict[str, np.ndarray]) -> Any:
        """Return the environment's batched actions for values {name: [E, D]} of all components."""
        if not self._rest.size:
            chosen = self._table[values["action"][:, 0]]
            return chosen.reshape(len(chosen), *self._space.shape)
        actions = np.empty((len(values[_CHOICE]), self._columns.size + self._rest.size), self._space.dtype)
        actions[:, self._columns] = self._table[values[_CHOICE][:, 0]]
        actions[:, self._rest] = self._rest_actions.of(values[_REST])
        return actions.reshape(len(actions), *self._space.shape)

    def add_outputs(self, graph: "OnnxGraph", values: Mapping[str, str]) -> None:
        """Add what `env_actions` does to an ONNX graph: the output `action`."""
        choice = graph.reshaped(values[_CHOICE if self._rest.size else "action"], ())
        actions = graph.add("Gather", graph.constant(self._table), choice, axis=0)
        if self._rest.size:
            actions = graph.add("Concat", actions, self._rest_actions.exported(graph, values[_REST]), axis=1)
            order = np.argsort(np.concatenate([self._columns, self._rest]))
            actions = graph.add("Gather", actions, graph.constant(order, np.int64), axis=1)
        dtype = exported_dtype(self._space)
        graph.output("action", graph.cast(actions, dtype), dtype, self._space.shape)


def _checked_columns(columns: tuple[int, ...], space: gymnasium.spaces.Box, size: int) -> np.ndarray:
    if len(set(columns)) < len(columns):
        raise EnvironmentSetupError(f"environment.action_table_columns names a number twice: {list(columns)}")
    if max(columns) >= size:
        raise EnvironmentSetupError(
            f"environment.action_table_columns names number {max(columns)}, but an action of space {described(space)} "
            f"has the numbers 0 to {size - 1}"
        )
    return np.asarray(columns)


def _checked_table(
    table: tuple[tuple[float, ...], ...], columns: np.ndarray, space: gymnasium.spaces.Box
) -> np.ndarray:
    """Return the rows of the table [count, len(columns)], in the order and the dtype of the action's numbers."""
    low, high = space.low.ravel()[columns], space.high.ravel()[columns]
    of_integers = space.dtype is not None and space.dtype.kind != "f"
    for number, row in enumerate(table):
        if len(row) != columns.size:
            few = columns.size < space.low.size
            expected = "action_table_columns names" if few else f"an action of space {described(space)} has"
            raise EnvironmentSetupError(
                f"environment.action_table row {number} has {len(row)} numbers, but {expected} {columns.size}"
            )
        # In the space's own precision, in which a bound such as 0.7 is another number; integers would be truncated.
        action = np.asarray(row, np.float64 if of_integers else space.dtype)
        if not ((action >= low) & (action <= high)).all():
            raise EnvironmentSetupError(
                f"environment.action_table row {number} is {row}, outside action space {described(space)}"
            )
        if of_integers and (action != np.rint(action)).any():
            raise EnvironmentSetupError(
                f"environment.action_table row {number} is {row}, but action space {described(space)} has integers"
            )
    return np.asarray(table, space.dtype)
