"""Checks of the components of a rollout, its observations, actions and masks, against the spaces. Pure functions."""

from collections.abc import Iterable

import numpy as np

from daedalus.protocol.spaces import ArraySpace, ContinuousSpace, DiscreteSpace, Spaces, unfit_number
from daedalus.protocol.texts import MAX_NAME, bounded_text
from daedalus.protocol.uploads import Rollout

_MAX_LOG_DENSITY = 20.0  # of one continuous action: its density cannot be higher, and float32 hold the noise
_MAX_ACTION = 1e6  # of a continuous action: beyond it squares lose all precision


def first_component_violation(rollout: Rollout, spaces: Spaces) -> str:
    """Return where observations, actions, masks or log-probabilities break the spaces, or an empty string."""
    for kind, given, expected in (
        ("frames", rollout.frames, spaces.observations),
        ("actions", rollout.actions, spaces.actions),
        ("masks", rollout.masks, spaces.masks),
    ):
        if given.keys() != expected.keys():
            return f"{kind} has the components {listed_names(given)}, expected {listed_names(expected)}"
    for name, space in spaces.observations.items():
        violation = _observation_violation(rollout, rollout.frames[name], space)
        if violation:
            return f"frames/{name} {violation}"
    for name, space in spaces.actions.items():
        violation = _action_violation(rollout, rollout.actions[name], space)
        if not violation and isinstance(space, DiscreteSpace) and space.masked:
            violation = _mask_violation(rollout, rollout.actions[name], rollout.masks[name], space)
        if violation:
            return f"actions/{name} {violation}"
    return _log_prob_violation(rollout, spaces)


def listed_names(names: Iterable[str]) -> str:
    """Return the first names, each bounded because a peer may have chosen it."""
    return ", ".join(bounded_text(name, MAX_NAME) for name in sorted(names)[:8]) or "none"


def _observation_violation(rollout: Rollout, frames: np.ndarray, space: ArraySpace | DiscreteSpace) -> str:
    expected = (rollout.rows + space.frames, rollout.environments, *space.shape)
    if frames.shape != expected or frames.dtype != space.dtype:
        return f"is {frames.dtype} {frames.shape}, expected {space.dtype} {expected} ({space})"
    if isinstance(space, DiscreteSpace):
        return "" if (frames < np.array(space.counts)).all() else f"has a value outside {space}"
    if frames.dtype == np.uint8:
        return ""
    return unfit_number(frames)


def _action_violation(rollout: Rollout, actions: np.ndarray, space: DiscreteSpace | ContinuousSpace) -> str:
    expected = (rollout.rows, rollout.environments, space.size)
    if actions.shape != expected or (actions.dtype.kind in "iu") != isinstance(space, DiscreteSpace):
        return f"is {actions.dtype} {actions.shape}, expected {space.dtype} {expected} ({space})"
    if isinstance(space, DiscreteSpace):
        legal = (actions >= 0) & (actions < np.array(space.counts))
        return "" if legal.all() else f"has a value outside {space}"
    if not np.isfinite(actions).all():
        return "has a value that is not finite"
    return "" if np.abs(actions).max() <= _MAX_ACTION else f"has a value beyond +-{_MAX_ACTION:g}"


def _mask_violation(rollout: Rollout, actions: np.ndarray, mask: np.ndarray, space: DiscreteSpace) -> str:
    expected = (rollout.rows, rollout.environments, space.choices)
    if mask.shape != expected:
        return f"has a mask of shape {mask.shape}, expected {expected}"
    first = 0
    for variable, count in enumerate(space.counts):
        part = mask[:, :, first : first + count]
        if not part.any(-1).all():
            row, environment = np.argwhere(~part.any(-1))[0]
            return f"has a mask that forbids every choice in row {row} of environment {environment}"
        chosen = np.take_along_axis(part, actions[:, :, variable : variable + 1].astype(np.int64), -1)
        if not chosen.all():
            row, environment = np.argwhere(~chosen[..., 0])[0]
            return f"has a choice that its mask forbids, in row {row} of environment {environment}"
        first += count
    return ""


def _log_prob_violation(rollout: Rollout, spaces: Spaces) -> str:
    """A probability is at most 1. A density has no such bound, but that of a learned distribution is limited."""
    continuous = sum(space.size for space in spaces.actions.values() if isinstance(space, ContinuousSpace))
    largest = _MAX_LOG_DENSITY * continuous
    if (rollout.behaviour_log_probs > largest + 1e-4).any():
        return f"behaviour_log_probs has a value above {largest:g}"
    return ""
