"""A client's spaces as it states them, and values of them between its messages and gymnasium. Pure functions.

Spaces are those of protocol/spaces.py: maps of named components. A value is a map by component name too; an observation
whose only component is named `observation`, and an action whose only one is named `action`, are bare values.
"""

import contextlib
import itertools
import math
import operator
from array import array
from collections.abc import Mapping, Sequence
from typing import Any

import gymnasium
import numpy as np
from gymnasium import spaces as gym
from pydantic import ValidationError

from daedalus.actor.environments.environment_errors import EnvironmentSetupError
from daedalus.actor.environments.pixels import Pixels
from daedalus.gateway.client_messages import ClientError
from daedalus.protocol.spaces import (
    LARGEST_OBSERVATION,
    ArraySpace,
    ContinuousSpace,
    DiscreteSpace,
    Spaces,
    unfit_number,
)
from daedalus.protocol.spec import EnvironmentSpec

_NUMBER_BYTES, _INTEGER_BYTES, _FLAG_BYTES = 32, 8, 8  # of one value in JSON, with a comma and some indentation
_NAME_BYTES, _MESSAGE_BYTES = 128, 4096  # of one component's name, and of everything else in a message
_TYPE_CODES = {"float32": "d", "uint8": "B", "uint16": "H"}  # of array.array

_Component = ArraySpace | DiscreteSpace | ContinuousSpace


class UniformBox(gym.Box):
    """A Box with two bounds for all its numbers, held once: gymnasium's takes ten bytes for each number.

    Any client can state a large space, and the learner refuses it only later.
    """

    def __init__(self, low: float, high: float, shape: tuple[int, ...], dtype: type[np.uint8 | np.float32]) -> None:
        super().__init__(low, high, (), dtype)
        self._shape = shape
        self.low, self.high = np.broadcast_to(self.low, shape), np.broadcast_to(self.high, shape)
        self.bounded_below = np.broadcast_to(self.bounded_below, shape)
        self.bounded_above = np.broadcast_to(self.bounded_above, shape)


class ClientSpaces:
    """The spaces of one client."""

    def __init__(self, observations: Any, actions: Any) -> None:
        """Raise ClientError if `observations` and `actions` do not describe spaces."""
        try:
            self.stated = Spaces.model_validate({"observations": observations, "actions": actions})
        except (ValidationError, RecursionError) as fault:
            raise ClientError("misfit", f"the spaces in hello are wrong: {_first_fault(fault)}") from None
        self._observations, self._actions = self.stated.observations, self.stated.actions
        for name, space in self._observations.items():
            if isinstance(space, ArraySpace) and space.frames != 1:
                raise ClientError("misfit", f"{name}.frames must be 1: the run stacks frames, and the client sends one")
            if isinstance(space, DiscreteSpace) and space.masked:
                raise ClientError("misfit", f"{name}.masked is for actions")
        self.observation_space = _nested_space(self._observations, bare="observation")
        self.action_space = _nested_space(self._actions, bare="action")
        self._limits = {
            name: _stated_limits(actions[name])
            for name, space in self._actions.items()
            if isinstance(space, ContinuousSpace)
        }
        self._masks = self.stated.masks
        self.example_mask = {name: np.ones(size, np.bool_) for name, size in self._masks.items()} or None

    @property
    def max_message_bytes(self) -> int:
        """Largest message of this client that can be legal."""
        size = _MESSAGE_BYTES + sum(_NAME_BYTES + _FLAG_BYTES * choices for choices in self._masks.values())
        for space in self._observations.values():
            number = _NUMBER_BYTES if space.dtype == "float32" else _INTEGER_BYTES
            size += _NAME_BYTES + number * math.prod(space.shape)
        return size + sum(_NAME_BYTES + _NUMBER_BYTES * space.size for space in self._actions.values())

    def observation(self, value: Any) -> Any:
        """Return an observation as gymnasium has it; numbers in JSON are float64 yet. Raises ClientError."""
        if self._observations.keys() == {"observation"}:
            return _array(value, self._observations["observation"], "the observation")
        parts = _components(value, self._observations.keys(), "the observation")
        arrays = {
            name: _array(parts[name], space, f"{name} of the observation") for name, space in self._observations.items()
        }
        return _nested(arrays)

    def action_mask(self, value: Any) -> dict[str, np.ndarray] | None:
        """Return the masks by component. Raises ClientError if they do not fit."""
        if not self._masks:
            if value is not None:
                raise ClientError("misfit", "an action_mask came, but no action is masked in the hello")
            return None
        if value is None:
            raise ClientError("misfit", "act lacks the action_mask: the hello says that actions are masked")
        bare = self._masks.keys() == {"action"} and not isinstance(value, dict)
        parts = {"action": value} if bare else _components(value, self._masks.keys(), "the action_mask")
        return {name: _mask(parts[name], self._actions[name], name) for name in self._masks}

    def checked_action(self, value: Any) -> Any:
        """Return an action as gymnasium has it, from one as `action` returns it. Raises ClientError if it is none."""
        bare = self._actions.keys() == {"action"} and not isinstance(value, dict)
        parts = {"action": value} if bare else _components(value, self._actions.keys(), "the override")
        actions = {
            name: _checked_action(parts[name], space, "the override" if bare else f"{name} of the override")
            for name, space in self._actions.items()
        }
        return actions["action"] if actions.keys() == {"action"} else _nested(actions)

    def action(self, value: Any) -> Any:
        """Return gymnasium's action as numbers, lists and maps by component."""
        if self._actions.keys() == {"action"}:
            return self._plain("action", value)
        return {name: self._plain(name, _found(value, name)) for name in self._actions}

    def _plain(self, name: str, value: Any) -> Any:
        if name in self._limits:  # float32, in which a bound such as 0.1 is another number
            return np.asarray(value, np.float64).reshape(-1).clip(*self._limits[name]).tolist()
        return int(value) if self._actions[name].size == 1 else np.asarray(value).reshape(-1).tolist()


def _first_fault(fault: ValidationError | RecursionError) -> str:
    if isinstance(fault, RecursionError):
        return "they are nested too deeply"
    first = fault.errors(include_url=False, include_input=False)[0]
    where = ".".join(ascii(part)[:40].strip("'") for part in first["loc"])
    return f"{where}: {first['msg']}"[:300]


def _gym(space: _Component) -> gymnasium.Space:
    match space:
        case ArraySpace(dtype="uint8"):
            return UniformBox(0, 255, space.shape, np.uint8)
        case ArraySpace():
            return UniformBox(-np.inf, np.inf, space.shape, np.float32)
        case DiscreteSpace(counts=(count,)):
            return gym.Discrete(count)
        case DiscreteSpace():
            return gym.MultiDiscrete(list(space.counts))
        case ContinuousSpace():
            return gym.Box(*space.limits(), dtype=np.float32)


def _nested_space(components: Mapping[str, _Component], *, bare: str) -> gymnasium.Space:
    """Return a space whose components have these names: the actor joins the keys of nested spaces by dots.

    A space whose only component is named `bare` is no map.
    """
    if components.keys() == {bare}:
        return _gym(components[bare])

    def built(tree: Any) -> gymnasium.Space:
        return gym.Dict({key: built(part) for key, part in tree.items()}) if isinstance(tree, dict) else _gym(tree)

    return built(_nested(components))


def _nested(components: Mapping[str, Any]) -> dict[str, Any]:
    """Return nested maps from names with dots. Raises ClientError if a name is also the beginning of another."""
    nested: dict[str, Any] = {}
    for name, value in components.items():
        *folders, last = name.split(".")
        inner = nested
        for folder in folders:
            inner = inner.setdefault(folder, {})
            if not isinstance(inner, dict):
                raise ClientError("misfit", f"the components {folder!r} and {name!r} have like names")
        if last in inner:
            raise ClientError("misfit", f"the component {name!r} has the name of others")
        inner[last] = value
    return nested


def _stated_limits(space: Mapping[str, Any]) -> tuple[np.ndarray, np.ndarray]:
    """Return the lowest and the highest numbers [D] of a continuous component as the client has them, in float64."""
    low = [-np.inf if bound is None else float(bound) for bound in space["low"]]
    high = [np.inf if bound is None else float(bound) for bound in space["high"]]
    return np.array(low), np.array(high)


def _found(value: Any, name: str) -> Any:
    for key in name.split("."):
        value = value[key]
    return value


def _components(value: Any, names: Any, what: str) -> dict[str, Any]:
    if not isinstance(value, dict) or value.keys() != names:
        raise ClientError("misfit", f"{what} must be a map with {', '.join(sorted(names))}")
    return value


def _array(value: Any, space: ArraySpace | DiscreteSpace, what: str) -> np.ndarray:
    """Return one component of an observation: a flat list, or lists nested as its shape, row by row."""
    if isinstance(value, bytes):  # of msgpack: the numbers themselves, little-endian
        item = np.dtype(space.dtype).newbyteorder("<")
        if len(value) != math.prod(space.shape) * item.itemsize:
            raise ClientError("misfit", f"{what} has {len(value)} bytes, but its space is {space}")
        values = np.frombuffer(value, item)
    else:
        values = _converted(value, space, what)
    if isinstance(space, DiscreteSpace):
        if (values >= space.counts).any():
            raise _out_of_range(space, what)
        return values.astype(np.int64) if space.size > 1 else np.int64(values[0])  # type: ignore[return-value] - gymnasium's Discrete has numbers, not arrays
    if space.dtype == "uint8":
        return values.astype(np.uint8).reshape(space.shape)
    if unfit := unfit_number(np.asarray(values, np.float64)):
        raise ClientError("misfit", f"{what} {unfit}")
    return values.reshape(space.shape)


def _converted(value: Any, space: ArraySpace | DiscreteSpace, what: str) -> np.ndarray:
    """Return the numbers of nested lists in one dimension. Raises ClientError if they do not fit the space.

    array.array accepts nothing but numbers, and no fractions for integers. numpy.asarray accepts texts, and would
    allocate the size of the longest text for each element.
    """
    try:
        shape, elements = _flat(value)
        numbers = np.asarray(array(_TYPE_CODES[space.dtype], elements))
    except (TypeError, ValueError):
        kind = "numbers" if space.dtype == "float32" else "integers"
        raise ClientError("misfit", f"{what} is not an array of {kind}") from None
    except OverflowError:
        raise _out_of_range(space, what) from None
    if numbers.size != math.prod(space.shape):
        raise ClientError("misfit", f"{what} has {numbers.size} values, but its space is {space}")
    if not _rows_of(shape) <= _rows_of(space.shape):  # such as an image whose width comes first
        raise ClientError(
            "misfit", f"{what} has the shape {tuple(shape)}, but its space is {space}: nest it so, or not"
        )
    return numbers


def _rows_of(shape: Sequence[int]) -> set[int]:
    """Return how many parts an array has if it is cut at each of its axes, from the first on."""
    return set(itertools.accumulate(shape, operator.mul, initial=1))


def _flat(value: Any) -> tuple[list[int], list[Any]]:
    """Return the shape of nested lists and their elements, or one element.

    Raises ValueError if the lists differ in length or depth.
    """
    elements = value if isinstance(value, list) else [value]
    shape = [len(elements)]
    while elements and isinstance(elements[0], list):
        if set(map(type, elements)) != {list} or len(set(map(len, elements))) > 1:
            raise ValueError
        shape.append(len(elements[0]))
        elements = list(itertools.chain.from_iterable(elements))
    return shape, elements


def _out_of_range(space: ArraySpace | DiscreteSpace, what: str) -> ClientError:
    if isinstance(space, DiscreteSpace):
        return ClientError("misfit", f"{what} is outside its space, {space}")
    if space.dtype == "uint8":
        return ClientError("misfit", f"{what} has a value that is not from 0 to 255")
    return ClientError("misfit", f"{what} has a value beyond +-{LARGEST_OBSERVATION:g}: scale the observations")


def _checked_action(value: Any, space: DiscreteSpace | ContinuousSpace, what: str) -> Any:
    """Return one component of an action as gymnasium has it, from a list or, if it is one number, from that."""
    types, kind = ({int}, "integers") if isinstance(space, DiscreteSpace) else ({int, float}, "numbers")
    try:
        _, elements = _flat(value)
    except ValueError:
        elements = []
    numbers = np.array(elements if set(map(type, elements)) <= types else [])
    if numbers.dtype.kind not in "iuf" or numbers.size != space.size:  # an integer of more than 64 bits is an object
        raise ClientError("misfit", f"{what} must have {space.size} {kind}, as its space is {space}")
    if isinstance(space, DiscreteSpace):
        fits = (numbers >= 0) & (numbers < space.counts)
    else:
        with np.errstate(over="ignore"):
            numbers = numbers.astype(np.float32)  # as the bounds are
        low, high = space.limits()
        fits = np.isfinite(numbers) & (numbers >= low) & (numbers <= high)
    if not fits.all():
        raise ClientError("misfit", f"{what} is outside its space, {space}")
    return np.int64(numbers[0]) if isinstance(space, DiscreteSpace) and space.size == 1 else numbers


def _mask(value: Any, space: _Component, name: str) -> np.ndarray:
    assert isinstance(space, DiscreteSpace)
    if not isinstance(value, list) or len(value) != space.choices or not set(map(type, value)) <= {bool, int}:
        raise ClientError("misfit", f"the action_mask of {name} must be a list of {space.choices} flags")
    if other := set(value) - {0, 1}:  # such as numbers of choices
        flags = "true or 1 for each legal choice, else false or 0"
        raise ClientError("misfit", f"the action_mask of {name} has the value {other.pop()}: write {flags}")
    first = 0
    for count in space.counts:
        if not any(value[first : first + count]):
            raise ClientError("misfit", f"the action_mask of {name} forbids every choice of a variable")
        first += count
    return np.array(value) != 0


MAX_IMAGE_BYTES = 8 << 20  # 1920 x 1080 pixels in RGB fit
MAX_SIDE = 8192  # pixels


def check_images(spaces: Spaces, spec: EnvironmentSpec) -> None:
    """Raise ClientError if an image of a client is too large for the pixel transforms of the run.

    Call it for spaces that the transforms fit: images that they do not fit are not transformed.
    """
    if spec.crop is None and not spec.grey and spec.resize is None:
        return
    for name, space in spaces.observations.items():
        if isinstance(space, ArraySpace) and space.dtype == "uint8" and name not in spec.leave_out:
            with contextlib.suppress(EnvironmentSetupError):
                _check_image(name, space, spec)


def _check_image(name: str, space: ArraySpace, spec: EnvironmentSpec) -> None:
    size = Pixels(spec, UniformBox(0, 255, space.shape, np.uint8)).largest_bytes
    if size > MAX_IMAGE_BYTES or max(space.shape) > MAX_SIDE:
        raise ClientError(
            "refused",
            f"{name} is an image of shape {space.shape}, for which the transforms of the run need {size:,} bytes: send "
            f"images of at most {MAX_SIDE:,} pixels a side that need at most {MAX_IMAGE_BYTES:,} bytes",
        )
