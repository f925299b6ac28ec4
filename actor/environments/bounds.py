"""The bounds of continuous actions: the policy acts between -1 and 1 where the environment has both bounds."""

import gymnasium
import numpy as np

from daedalus.protocol.spaces import ContinuousSpace

_UNBOUNDED = 1e30  # a bound beyond this value is none: environments write the largest float for infinity
_WIDE_BYTES = 4  # integers of fewer bytes use all their range, such as the colours of a pixel


def continuous_space(space: gymnasium.spaces.Box) -> ContinuousSpace:
    """Return the run's space for the actions of a Box, flattened. Raises ValidationError if it is not supported."""
    return ContinuousSpace(low=_bounds(space.low), high=_bounds(space.high))


class BoundedActions:
    """Actions of a Box for the values that a policy chooses: [-1, 1] is scaled to the bounds where there are two."""

    def __init__(self, space: gymnasium.spaces.Box) -> None:
        self._space = space
        self._low, self._high = space.low.ravel().astype(np.float64), _highest(space.high)
        if space.dtype == np.float16:  # without a bound, it cannot hold every number of a policy
            largest = float(np.finfo(np.float16).max)
            self._low, self._high = np.maximum(self._low, -largest), np.minimum(self._high, largest)
        self._bounded = _is_bound(space.low) & _is_bound(space.high)
        with np.errstate(invalid="ignore", over="ignore"):
            self._range = self._high - self._low
            self._centre = np.where(self._bounded, self._low + 0.5 * self._range, 0.0).clip(self._low, self._high)
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
        # Of a policy that saw a value that is not finite. The learner refuses the row; but an environment that gets
        # such an action may return nothing finite any more, and an integer would be any.
        actions = np.where(np.isnan(actions), self._centre, actions)
        if self._rounded:
            actions = np.rint(actions)
        return actions.reshape(len(values), *self._space.shape).astype(self._space.dtype)


def _bounds(values: np.ndarray) -> tuple[float | None, ...]:
    numbers = values.ravel().astype(np.float64)
    return tuple(float(value) if is_bound else None for value, is_bound in zip(numbers, _is_bound(values), strict=True))


def _highest(values: np.ndarray) -> np.ndarray:
    """Return upper bounds as float64 that the dtype of the bounds can hold: the largest int64 is rounded up."""
    bounds = values.ravel().astype(np.float64)
    if values.dtype.kind not in "iu":
        return bounds
    return np.where(bounds >= float(np.iinfo(values.dtype).max) + 1.0, np.nextafter(bounds, 0.0), bounds)


def _is_bound(values: np.ndarray) -> np.ndarray:
    """Return whether each number limits anything. gymnasium writes the largest integer for infinity."""
    bounds = np.abs(values.ravel().astype(np.float64)) < _UNBOUNDED
    if values.dtype.kind in "iu" and values.dtype.itemsize >= _WIDE_BYTES:
        limits = np.iinfo(values.dtype)
        bounds &= (values.ravel() != limits.max) & ((values.ravel() != limits.min) | (limits.min == 0))
    return bounds
