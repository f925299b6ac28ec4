"""The bounds of continuous actions: the policy acts between -1 and 1 where the environment has both bounds."""

import gymnasium
import numpy as np

from daedalus.protocol.spaces import ContinuousSpace

_UNBOUNDED = 1e30  # a bound beyond this value is none: environments write the largest float for infinity


def continuous_space(space: gymnasium.spaces.Box) -> ContinuousSpace:
    """Return the run's space for the actions of a Box, flattened. Raises ValidationError if it is not supported."""
    return ContinuousSpace(low=_bounds(space.low), high=_bounds(space.high))


def unscaled(values: np.ndarray, space: gymnasium.spaces.Box) -> np.ndarray:
    """Return actions of the environment [E, *shape]: within its bounds, [-1, 1] scaled to them where there are two."""
    low, high = (bound.ravel().astype(np.float64) for bound in (space.low, space.high))
    bounded = (np.abs(low) < _UNBOUNDED) & (np.abs(high) < _UNBOUNDED)
    with np.errstate(invalid="ignore", over="ignore"):
        scaled = low + (values.astype(np.float64) + 1.0) * 0.5 * (high - low)
    actions = np.clip(np.where(bounded, scaled, values), low, high)
    if space.dtype is not None and space.dtype.kind != "f":
        actions = np.rint(actions)
    return actions.reshape(len(values), *space.shape).astype(space.dtype)


def _bounds(values: np.ndarray) -> tuple[float | None, ...]:
    return tuple(float(value) if abs(value) < _UNBOUNDED else None for value in values.ravel().astype(np.float64))
