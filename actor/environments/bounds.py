"""The bounds of continuous actions: the policy acts between -1 and 1 where the environment has both bounds."""

import gymnasium
import numpy as np

from daedalus.protocol.spaces import ContinuousSpace

_UNBOUNDED = 1e30  # a bound beyond this value is none: environments write the largest float for infinity


def continuous_space(space: gymnasium.spaces.Box) -> ContinuousSpace:
    """Return the run's space for the actions of a Box, flattened. Raises ValidationError if it is not supported."""
    return ContinuousSpace(low=_bounds(space.low), high=_bounds(space.high))


class BoundedActions:
    """Actions of a Box for the values that a policy chooses: [-1, 1] is scaled to the bounds where there are two."""

    def __init__(self, space: gymnasium.spaces.Box) -> None:
        self._space = space
        self._low, self._high = (bound.ravel().astype(np.float64) for bound in (space.low, space.high))
        self._bounded = (np.abs(self._low) < _UNBOUNDED) & (np.abs(self._high) < _UNBOUNDED)
        with np.errstate(invalid="ignore", over="ignore"):
            self._range = self._high - self._low
        self._rounded = space.dtype is not None and space.dtype.kind != "f"

    def of(self, values: np.ndarray) -> np.ndarray:
        """Return actions of the environment [E, *shape], within its bounds, for values [E, D]."""
        if self._bounded.all():
            scaled = self._low + (values.astype(np.float64) + 1.0) * 0.5 * self._range
        else:
            with np.errstate(invalid="ignore", over="ignore"):
                scaled = self._low + (values.astype(np.float64) + 1.0) * 0.5 * self._range
            scaled = np.where(self._bounded, scaled, values)
        actions = np.minimum(np.maximum(scaled, self._low), self._high)
        if self._rounded:
            actions = np.rint(actions)
        return actions.reshape(len(values), *self._space.shape).astype(self._space.dtype)


def _bounds(values: np.ndarray) -> tuple[float | None, ...]:
    return tuple(float(value) if abs(value) < _UNBOUNDED else None for value in values.ravel().astype(np.float64))
