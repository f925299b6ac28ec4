"""Checks of the content of rollouts and gradients against the spaces and the specification. Pure functions."""

import math
from collections.abc import Iterable, Mapping
from dataclasses import replace

import numpy as np

from daedalus.policy.component_inputs import coded_components, normalized_components
from daedalus.protocol.compact import bits_of, float32
from daedalus.protocol.limits import Limits
from daedalus.protocol.spaces import (
    LARGEST_OBSERVATION,
    LARGEST_REWARD,
    ArraySpace,
    ContinuousSpace,
    DiscreteSpace,
    Spaces,
    unfit_code,
    unfit_number,
)
from daedalus.protocol.spec import PolicySpec, RunSpec
from daedalus.protocol.texts import MAX_NAME, bounded_text
from daedalus.protocol.uploads import (
    DIAGNOSTICS,
    LARGEST_EPISODE_NUMBER,
    LARGEST_GRADIENT_NORM,
    LOSS_TERMS,
    MAX_INFO_NAMES,
    MAX_INFO_VALUES,
    Gradient,
    Rollout,
)

_MAX_LOG_DENSITY = 20.0  # of one continuous action: its density cannot be higher, and float32 hold the noise
_MAX_ACTION = 1e6  # of a continuous action: beyond it squares lose all precision

# Largest magnitudes. No healthy actor comes near them, and beyond them squares overflow float32: updates would have no
# finite gradient. The state of a GRU lies between -1 and 1.
_LARGEST = {
    "initial_state": 1.001,
    "behaviour_log_probs": 1e6,
    "rewards": LARGEST_REWARD,
    "episode_returns": LARGEST_EPISODE_NUMBER,
}
_REMEDIES = {
    "rewards": ": set environment.reward_scale",
}


def first_component_violation(rollout: Rollout, spaces: Spaces, policy: PolicySpec) -> str:
    """Return where observations, actions, masks or log-probabilities break the spaces, or an empty string.

    So do observations that are no codes of the `policy`.
    """
    for kind, given, expected in (
        ("frames", rollout.frames, spaces.observations),
        ("actions", rollout.actions, spaces.actions),
        ("masks", rollout.masks, spaces.masks),
    ):
        if given.keys() != expected.keys():
            return f"{kind} has the components {listed_names(given)}, expected {listed_names(expected)}"
    coded = coded_components(policy, spaces.observations)
    for name, space in spaces.observations.items():
        violation = _observation_violation(rollout, rollout.frames[name], space)
        if not violation and name in coded:
            violation = unfit_code(rollout.frames[name], coded[name])
        if violation:
            return f"frames/{name} {violation}"
    for name, space in spaces.actions.items():
        violation = _action_violation(rollout, rollout.actions[name], space)
        if not violation and isinstance(space, DiscreteSpace) and space.masked:
            violation = _mask_violation(rollout, rollout.actions[name], rollout.masks[name], space)
        if violation:
            return f"actions/{name} {violation}"
    return _log_prob_violation(rollout, spaces)


def number_violation(rollout: Rollout) -> str:
    """Return the first array with a value that is not finite or too large, or an empty string."""
    for name, largest in _LARGEST.items():
        array: np.ndarray = getattr(rollout, name)
        if array.dtype.kind != "f" or not array.size:
            continue
        low, high = float(array.min()), float(array.max())  # nan if there is a nan
        if not (math.isfinite(low) and math.isfinite(high)):
            return f"{name} has a value that is not finite"
        if max(-low, high) > largest:
            return f"{name} has a value beyond +-{largest:g}{_REMEDIES.get(name, '')}"
    return _info_violation(rollout)


def _info_violation(upload: Rollout | Gradient) -> str:
    for name, values in upload.episode_info.items():
        if not (np.abs(values) <= LARGEST_EPISODE_NUMBER).all():
            return f"episode_info {name!r} has a value that is not finite, or too large"
    return ""


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
    largest = _MAX_LOG_DENSITY * spaces.continuous_numbers
    if (rollout.behaviour_log_probs > largest + 1e-4).any():
        return f"behaviour_log_probs has a value above {largest:g}"
    return ""


Shapes = Mapping[str, tuple[int, ...]]

_LARGEST_METRIC = 1e30
_LARGEST_MOMENT = LARGEST_OBSERVATION**2  # of one row
_ARRAY_BYTES = 16  # padding of each array, rounded up
_MAX_METRICS = len(LOSS_TERMS) + len(DIAGNOSTICS)


def gradient_limits(spec: RunSpec, shapes: Shapes, spaces: Spaces, environments: int) -> Limits:
    """Return the size limits of a gradient of an actor with so many environments."""
    size = sum(4 * math.prod(shape) + _ARRAY_BYTES for shape in shapes.values())
    moments = expected_moments(spec, spaces)
    size += sum(8 * math.prod(shape) + _ARRAY_BYTES for shape in moments.values())
    discrete = spaces.discrete_actions
    size += sum(8 * space.choices + _ARRAY_BYTES for space in discrete.values())
    episodes = spec.collection.rollout_length * environments
    size += (12 + 8 * len(spec.lessons)) * episodes + len(spec.lessons) * _ARRAY_BYTES
    size += MAX_INFO_NAMES * (4 * MAX_INFO_VALUES + _ARRAY_BYTES) + _MAX_METRICS * _ARRAY_BYTES
    arrays = len(shapes) + len(moments) + len(discrete) + MAX_INFO_NAMES + _MAX_METRICS + len(spec.lessons) + 2
    return Limits(max_bytes=size, max_arrays=arrays)


def expected_moments(spec: RunSpec, spaces: Spaces) -> dict[str, tuple[int, ...]]:
    """Return the names and shapes of the moments in a gradient."""
    normalized = normalized_components(spec.policy, spaces.observations)
    shapes: dict[str, tuple[int, ...]] = {
        f"observations/{name}": (2, *space.stacked_shape) for name, space in normalized.items()
    }
    if spec.training.normalize_rewards:
        shapes["returns"] = (2,)
    return shapes


def restored(gradient: Gradient) -> Gradient:
    """Return the gradient in float32."""
    compact = {name: values for name, values in gradient.gradient.items() if values.dtype == np.uint8}
    return replace(gradient, gradient={**gradient.gradient, **float32(bits_of(compact, None))})


def gradient_violation(gradient: Gradient, spec: RunSpec, shapes: Shapes, spaces: Spaces, environments: int) -> str:
    """Return a description of the first violation of a `restored` gradient, or an empty string.

    Args:
      gradient: what the actor sent.
      spec, spaces: of the run.
      shapes: those of the parameters that have gradients, by name.
      environments: number of environments of the actor.
    """
    most = spec.collection.rollout_length * environments
    if gradient.env_steps > most:
        return f"env_steps is {gradient.env_steps}, but a rollout of this actor has {most} rows"
    return (
        _gradient_violation(gradient, shapes)
        or _moments_violation(gradient, expected_moments(spec, spaces))
        or _counts_violation(gradient, spaces)
        or _metrics_violation(gradient)
        or _episodes_violation(gradient)
    )


def _gradient_violation(gradient: Gradient, shapes: Shapes) -> str:
    given = {name: values.shape for name, values in gradient.gradient.items()}
    different = next((name for name in sorted({*given, *shapes}) if given.get(name) != shapes.get(name)), None)
    if different is not None:
        return (
            f"the gradient of {bounded_text(different, MAX_NAME)!r} is {_shape(given.get(different))}, and in this "
            f"run's network {_shape(shapes.get(different))}: install the release and the modules that the learner uses"
        )
    norm = gradient.norm
    if not math.isfinite(norm) and not all(np.isfinite(values).all() for values in gradient.gradient.values()):
        return (
            "the gradient has a value that is not finite: its observations or rewards are not finite, or too large, or "
            "an observation has a value that is not among policy.codes"
        )
    if not norm <= LARGEST_GRADIENT_NORM:  # nor nan
        return (
            f"the norm of the gradient is {norm:.3g}, at most {LARGEST_GRADIENT_NORM:g} is allowed: "
            "its observations or rewards are too large"
        )
    return ""


def _shape(shape: tuple[int, ...] | None) -> str:
    return "absent" if shape is None else str(list(shape))


def _moments_violation(gradient: Gradient, expected: dict[str, tuple[int, ...]]) -> str:
    given = {name: values.shape for name, values in gradient.moments.items()}
    if given != expected:
        return f"moments are of {_shapes(given)}, expected {_shapes(expected)}"
    most = gradient.env_steps * _LARGEST_MOMENT
    for name, values in gradient.moments.items():
        if not np.isfinite(values).all():
            return f"moments/{name} has a value that is not finite"
        mean, squares = values
        if np.abs(mean).max() > _LARGEST_MOMENT or squares.min() < 0.0 or squares.max() > most:
            return f"moments/{name} has a value that no rollout has"
    return ""


def _counts_violation(gradient: Gradient, spaces: Spaces) -> str:
    discrete = spaces.discrete_actions
    if gradient.action_counts.keys() != discrete.keys():
        return f"action_counts are of {listed_names(gradient.action_counts)}, expected {listed_names(discrete)}"
    for name, space in discrete.items():
        counts = gradient.action_counts[name]
        most = gradient.env_steps
        if (
            counts.shape != (space.choices,)
            or (counts < 0).any()
            or (counts > most).any()  # before the sums, which could overflow
            or (np.add.reduceat(counts, np.cumsum((0, *space.counts[:-1]))) > most).any()
        ):
            return f"action_counts/{name} is not a count of {space.choices} choices in {most} env_steps"
    return ""


def _metrics_violation(gradient: Gradient) -> str:
    names = gradient.metrics.keys()
    if not set(LOSS_TERMS) <= names <= {*LOSS_TERMS, *DIAGNOSTICS}:
        return f"metrics has the names {listed_names(gradient.metrics)}, expected {', '.join(LOSS_TERMS)}"
    for name, value in gradient.metrics.items():
        if not abs(float(value)) <= _LARGEST_METRIC:  # nor nan
            return f"metrics/{name} is {float(value)}, at most {_LARGEST_METRIC:g} is allowed"
    return ""


def _episodes_violation(gradient: Gradient) -> str:
    if len(gradient.episode_returns) > gradient.env_steps:
        return f"{len(gradient.episode_returns)} episodes ended in {gradient.env_steps} env_steps"
    if not (np.abs(gradient.episode_returns) <= LARGEST_EPISODE_NUMBER).all():
        return "episode_returns has a value that is not finite, or too large"
    if (gradient.episode_lengths < 1).any():
        return "episode_lengths has a value below 1"
    return _info_violation(gradient)


def _shapes(shapes: Mapping[str, tuple[int, ...]]) -> str:
    return ", ".join(f"{bounded_text(name, MAX_NAME)} {list(shapes[name])}" for name in sorted(shapes)[:8]) or "none"
