"""Where the results of an environment break gymnasium's interface. Pure functions.

A problem makes training fail; a warning does not. Both are clauses without the name of the environment.
"""

import math
from collections.abc import Iterator, Mapping
from typing import Any

import gymnasium
import numpy as np

from daedalus.actor.environments.components import LeftOut, dtype_misfit
from daedalus.protocol.spaces import LARGEST_OBSERVATION, LARGEST_REWARD, ArraySpace, Spaces
from daedalus.protocol.spec import EnvironmentSpec

Violation = tuple[str, str]  # "problem" or "warning", and the text


def observation_violations(space: gymnasium.Space, value: Any, call: str) -> Iterator[Violation]:
    """Yield what makes an observation, returned by `call`, differ from its space. Parts that are LeftOut may differ."""
    yield from _violations(space, value, f"{call} returns an observation", "observation_space")


def _violations(space: gymnasium.Space, value: Any, what: str, where: str) -> Iterator[Violation]:
    match space:
        case LeftOut():
            return
        case gymnasium.spaces.Dict():
            yield from _parts(dict(space.spaces), value, what, where)
        case gymnasium.spaces.Tuple():
            parts = dict(enumerate(space.spaces))
            items = dict(enumerate(value)) if isinstance(value, tuple | list) else value
            yield from _parts(parts, items, what, where)
        case gymnasium.spaces.Box():
            yield from _array_violations(space, value, what, where)
        case _ if not space.contains(value):
            yield "problem", f"{what} {_shown(value)}, which is not in {where} {space}"


def _parts(spaces: Mapping[Any, gymnasium.Space], value: Any, what: str, where: str) -> Iterator[Violation]:
    if not isinstance(value, Mapping):
        yield "problem", f"{what} of type {type(value).__name__}, but {where} has the parts {sorted(spaces, key=str)}"
        return
    if value.keys() != spaces.keys():
        is_missing = not spaces.keys() <= value.keys()
        parts = f"the parts {sorted(value, key=str)}, but {where} has the parts {sorted(spaces, key=str)}"
        yield "problem" if is_missing else "warning", f"{what} with {parts}"
        if is_missing:
            return
    for name, space in spaces.items():
        yield from _violations(space, value[name], f"{what} whose part {name!r} is", f"{where}[{name!r}]")


def _array_violations(space: gymnasium.spaces.Box, value: Any, what: str, where: str) -> Iterator[Violation]:
    try:
        array = np.asarray(value)
    except ValueError:
        array = np.array(None)
    if array.dtype.kind not in "biuf":
        yield "problem", f"{what} of type {type(value).__name__}, which is not an array of numbers; {where} is {space}"
    elif array.shape != space.shape:
        yield "problem", f"{what} of shape {array.shape}, but {where} has shape {space.shape}"
    elif not np.can_cast(array.dtype, space.dtype, "same_kind"):
        yield "problem", f"{what} of dtype {array.dtype}, but {where} has dtype {space.dtype}"
    elif changed := dtype_misfit(space, array):
        yield "problem", f"{what} that {changed}: declare {where} with a dtype that holds it"
    elif array.dtype.kind == "f" and not np.isfinite(array).all():
        index = _first(~np.isfinite(array))
        yield "problem", f"{what} with the value {array[index]} at index {_index(index)}: it must be finite"
    elif (large := np.abs(array.astype(np.float64)) > LARGEST_OBSERVATION).any():
        index = _first(large)
        limit = f"it must be within +-{LARGEST_OBSERVATION:g}: scale or clip it"
        yield "problem", f"{what} with the value {array[index]:g} at index {_index(index)}: {limit}"
    elif (outside := (array < space.low) | (array > space.high)).any():
        index = _first(outside)
        low, high, value = space.low[index], space.high[index], array[index]
        shown = f"{value:g}" if f"{value:g}" not in (f"{low:g}", f"{high:g}") else str(value)  # such as 1.0000001
        yield (
            "warning",
            (f"{what} with the value {shown} at index {_index(index)}, but {where} goes from {low:g} to {high:g}"),
        )


def _first(mask: np.ndarray) -> tuple[int, ...]:
    return tuple(int(each) for each in np.argwhere(mask)[0])


def _index(index: tuple[int, ...]) -> str:
    return str(index[0] if len(index) == 1 else index)


def _shown(value: Any) -> str:
    text = repr(value)
    return text if len(text) <= 60 else f"of type {type(value).__name__}"


def reset_violations(space: gymnasium.Space, result: Any) -> Iterator[Violation]:
    """Yield what is wrong with the result of `reset`."""
    if not isinstance(result, tuple) or len(result) != 2 or not isinstance(result[1], dict):
        yield "problem", f"reset returns {_structure(result)}; it must return a tuple (observation, info), info a dict"
        return
    yield from observation_violations(space, result[0], "reset")


def step_violations(space: gymnasium.Space, result: Any) -> Iterator[Violation]:
    """Yield what is wrong with the result of `step`."""
    if not isinstance(result, tuple) or len(result) != 5:
        expected = "(observation, reward, terminated, truncated, info)"
        yield "problem", f"step returns {_structure(result)}; it must return a tuple {expected}"
        return
    observation, reward, terminated, truncated, info = result
    yield from observation_violations(space, observation, "step")
    yield from reward_violations(reward)
    yield from flag_violations("terminated", terminated)
    yield from flag_violations("truncated", truncated)
    if not isinstance(info, dict):
        yield "problem", f"step returns info of type {type(info).__name__}: it must be a dict"


def reward_violations(reward: Any) -> Iterator[Violation]:
    """Yield what is wrong with a reward."""
    try:
        number = float(reward)
    except (TypeError, ValueError):
        yield "problem", f"step returns the reward {_shown(reward)}: it must be a number"
        return
    except OverflowError:  # an integer of hundreds of digits
        number = math.inf
    if not math.isfinite(number):
        yield "problem", f"step returns the reward {number}: it must be finite"


def flag_violations(name: str, flag: Any) -> Iterator[Violation]:
    """Yield what is wrong with `terminated` or `truncated`. A text such as "False" is true for Python: a problem."""
    if not isinstance(flag, bool | np.bool_):
        text = f"step returns {name}={_shown(flag)}, of type {type(flag).__name__}: it must be a bool"
        yield "warning" if flag is None or all_flags(flag, 1) else "problem", text


def all_flags(values: Any, count: int) -> bool:
    """Return whether values are `count` bools, or numbers that are 0 or 1."""
    try:
        array = np.asarray(values)
    except (TypeError, ValueError):  # such as lists of different lengths, and tensors on a GPU
        return False
    return array.size == count and (
        array.dtype == np.bool_ or (array.dtype.kind in "iuf" and set(array.flat) <= {0, 1})
    )


def learned_reward_violations(reward: float, spec: EnvironmentSpec) -> Iterator[Violation]:
    """Yield what is wrong with a finite reward after the clipping and scaling of the run: the learner rejects it."""
    clipped = abs(reward) if spec.reward_clip is None else min(abs(reward), spec.reward_clip)
    if clipped * spec.reward_scale > LARGEST_REWARD:
        limit = f"learning takes rewards within +-{LARGEST_REWARD:g}"
        yield "problem", f"step returns the reward {reward:g}, but {limit}: set environment.reward_scale"


def _structure(result: Any) -> str:
    if isinstance(result, tuple):
        return f"a tuple of {len(result)} ({', '.join(type(each).__name__ for each in result)})"
    return f"one value of type {type(result).__name__}"


_MOST_PLACES = 16  # of the last axis, which is else not one of channels


def byte_maxima(spaces: Spaces) -> dict[str, np.ndarray]:
    """Return zeros for the largest values of arrays of bytes: in each place of the last axis, or in all together."""
    return {
        name: np.zeros(space.shape[-1] if len(space.shape) == 3 and space.shape[-1] <= _MOST_PLACES else 1, np.uint8)
        for name, space in spaces.observations.items()
        if isinstance(space, ArraySpace) and space.dtype == "uint8" and 1 <= len(space.shape) <= 3
    }
