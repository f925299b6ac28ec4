"""The environment's nested spaces as flat maps of named components, and values of one in the other. Pure functions.

A component is a leaf of the nested space. It is named by the keys and indices that lead to it, joined by dots; a space
that is not composite has the name `observation` or `action`.
"""

import re
from collections.abc import Collection, Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import gymnasium
import numpy as np
from gymnasium import spaces as gym
from pydantic import ValidationError

from daedalus.actor.environments.environment_errors import EnvironmentSetupError, described, reason_of
from daedalus.protocol.spaces import ActionSpace, ContinuousSpace, DiscreteSpace

if TYPE_CHECKING:
    from daedalus.policy.saving.onnx_graph import OnnxGraph

_LONGEST_NAME = 64  # ComponentName of the protocol


class Leaf(NamedTuple):
    """A space that is not composite, and where it is in the nested space."""

    name: str
    path: tuple[str | int, ...]
    space: gymnasium.Space

    def of(self, value: Any) -> np.ndarray:
        """Return this component of a nested value; in a batch each component has the first axis E."""
        for key in self.path:
            value = value[key]
        return np.asarray(value)


def leaves(space: gymnasium.Space, whole: str) -> tuple[Leaf, ...]:
    """Return all leaves of a nested space, in gymnasium's order. `whole` is the name of a space that is not composite.

    Of leaves that would have the same name, as keys in Chinese may, the second is numbered 2, and so on. Raises
    EnvironmentSetupError if there are none.
    """
    found: dict[str, Leaf] = {}
    for path, leaf in _walk(space, ()):
        name = _unused(_name(path) if path else whole, found)
        found[name] = Leaf(name, path, leaf)
    if not found:
        raise EnvironmentSetupError(f"{whole} space {described(space)} is empty: it must have at least one component")
    return tuple(found.values())


def _walk(space: gymnasium.Space, path: tuple[str | int, ...]) -> Iterator[tuple[tuple[str | int, ...], Any]]:
    if isinstance(space, gym.Dict):
        for key, part in space.spaces.items():
            yield from _walk(part, (*path, key))
    elif isinstance(space, gym.Tuple):
        for index, part in enumerate(space.spaces):
            yield from _walk(part, (*path, index))
    else:
        yield path, space


def _name(path: tuple[str | int, ...]) -> str:
    """Return the keys in the letters that a name may have, joined by dots: the last 64, which tell most."""
    return ".".join(re.sub(r"[^\w-]", "_", str(key), flags=re.ASCII) or "_" for key in path)[-_LONGEST_NAME:]


def _unused(name: str, used: Collection[str]) -> str:
    """Return a name that is not used yet, with a number at its end if need be."""
    unused, number = name, 1
    while unused in used:
        number += 1
        ending = f"_{number}"
        unused = name[: _LONGEST_NAME - len(ending)] + ending
    return unused


class LeftOut(gymnasium.Space):
    """The place of a component that the policy does not see."""


def without(space: gymnasium.Space, names: Sequence[str]) -> gymnasium.Space:
    """Return an observation space whose components of these names are LeftOut.

    Raises EnvironmentSetupError for a name that is no component.
    """
    if not names:
        return space
    components = {leaf.name: leaf.path for leaf in leaves(space, "observation")}
    unknown = [name for name in names if name not in components]
    if unknown:
        raise EnvironmentSetupError(
            f"environment.leave_out names {unknown[0]!r}, but the components of the observation are "
            f"{', '.join(components)}"
        )
    return _without(space, (), {components[name] for name in names})


def _without(space: Any, path: tuple[str | int, ...], paths: Collection[tuple[str | int, ...]]) -> gymnasium.Space:
    if path in paths:
        return LeftOut()
    if isinstance(space, gym.Dict):
        return gym.Dict({key: _without(part, (*path, key), paths) for key, part in space.spaces.items()})
    if isinstance(space, gym.Tuple):
        return gym.Tuple([_without(part, (*path, index), paths) for index, part in enumerate(space.spaces)])
    return space


_ROUNDING = 1e-6  # of the range of an action
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

    def values(self, actions: np.ndarray) -> np.ndarray:
        """Return the values [E, D] float32 of actions [E, *shape]: `of` makes the actions of them again.

        Raises ValueError for an action outside the bounds.
        """
        flat = np.asarray(actions).reshape(len(actions), -1).astype(np.float64)
        with np.errstate(invalid="ignore", over="ignore"):
            slack = np.where(self._bounded, _ROUNDING * self._range, 0.0)  # bounds in float64 and actions in float32
            outside = ~((flat >= self._low - slack) & (flat <= self._high + slack))  # also nan
            scaled = np.where(self._range > 0.0, 2.0 * (flat - self._low) / self._range - 1.0, 0.0).clip(-1.0, 1.0)
        outside |= ~np.isfinite(flat)
        if outside.any():
            row, place = np.argwhere(outside)[0]
            raise ValueError(
                f"the action {flat[row, place]:g} is outside its bounds {self._low[place]:g} to {self._high[place]:g}"
            )
        return np.where(self._bounded, scaled, flat).astype(np.float32)

    def exported(self, graph: "OnnxGraph", values: str) -> str:
        """Add what `of` does to an ONNX graph, in float32: [rows, D] -> [rows, D]. NaN has no centre there."""
        low, high = _inside(self._low, self._high)
        if self._bounded.any():
            start, half = (np.where(self._bounded, each, 0.0) for each in (self._low, 0.5 * self._range))
            scaled = graph.add("Add", values, graph.constant(1.0))
            scaled = graph.add("Add", graph.add("Mul", scaled, graph.constant(half)), graph.constant(start))
            everywhere = self._bounded.all()
            kept = graph.constant(self._bounded, np.bool_)
            values = scaled if everywhere else graph.add("Where", kept, scaled, values)
        values = graph.add("Min", graph.add("Max", values, graph.constant(low)), graph.constant(high))
        return graph.add("Round", values) if self._rounded else values


def _inside(low: np.ndarray, high: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return bounds in float32, rounded to the inner side."""
    with np.errstate(over="ignore"):
        rounded_low, rounded_high = low.astype(np.float32), high.astype(np.float32)
    rounded_low = np.where(rounded_low < low, np.nextafter(rounded_low, np.float32(np.inf)), rounded_low)
    return rounded_low, np.where(rounded_high > high, np.nextafter(rounded_high, np.float32(-np.inf)), rounded_high)


def exported_dtype(space: gymnasium.Space) -> type:
    """Return the dtype of an action in an ONNX file: float32 for numbers with fractions, else int64."""
    return np.float32 if isinstance(space, gym.Box) and space.dtype.kind == "f" else np.int64


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


_MAX_DIMENSIONS = 4


def is_text(space: gymnasium.Space) -> bool:
    """Return whether the values of a space are texts: gymnasium's Text, or MiniGrid's missions."""
    return space.dtype is not None and space.dtype.kind == "U"


def unsupported(kind: str, leaf: Leaf) -> EnvironmentSetupError:
    """Return the error for a leaf that has no component: of another kind, or a Box without numbers or of five axes."""
    where = f" (component {leaf.name!r})" if leaf.path else ""
    remedy = "use Box, Discrete, MultiDiscrete or MultiBinary, or a Dict or Tuple of these"
    if isinstance(leaf.space, gym.Box | gym.MultiBinary):
        axes = f"with at most {_MAX_DIMENSIONS} axes" if kind == "observation" else "of numbers"
        remedy = f"use an array {axes} that is not empty"
    if kind == "observation" and leaf.path:
        remedy += f"; or leave the component out: --set \"environment.leave_out=['{leaf.name}']\""
    return EnvironmentSetupError(f"{kind} space {described(leaf.space)}{where} is not supported: {remedy}")


# ------------------------------------------------------------------------------------------------ observations


class ObservationComponent(NamedTuple):
    """One component of the environment's observations, before the transforms of the run."""

    leaf: Leaf
    shape: tuple[int, ...]  # of one frame
    first: np.ndarray | None  # of a discrete component: the number of the first choice of each variable [D]
    counts: tuple[int, ...] = ()  # of a discrete component: the number of choices of each variable

    def values(self, observations: Any) -> np.ndarray:
        """Return this component of batched observations: [E, *shape], uint8 or float32, discrete ones counted from 0.

        Raises EnvironmentSetupError for values of another shape than the space has, or that its dtype would change,
        and for a discrete or binary value outside the space, as batch_of_one does for those of other loops.
        """
        values = self.leaf.of(observations)
        space = self.leaf.space
        if values.shape[1:] != (space.shape or ()) or values.dtype != space.dtype or not values.ndim:
            values = self._fitted(values)
        values = values.reshape(len(values), *self.shape)
        if self.first is not None:
            if ((values < self.first) | (values >= self.first + self.counts)).any():
                raise self._outside(values)
            return values - self.first
        if isinstance(space, gym.MultiBinary) and ((values < 0) | (values > 1)).any():
            raise self._outside(values)
        if values.dtype in (np.uint8, np.float32):
            return values
        with np.errstate(all="ignore"):  # the learner, or the evaluation, names a value that is not finite
            return values.astype(np.float32)

    def add_input(self, graph: "OnnxGraph") -> str:
        """Add this component as an input of an ONNX graph, and return what `values` does of it.

        The input has the shape of the component in the environment, and is int64 for a discrete one, uint8 where the
        environment's is, else float32.
        """
        space = self.leaf.space
        dtype = np.int64 if self.first is not None else np.uint8 if space.dtype == np.uint8 else np.float32
        values = graph.input(self.leaf.name, dtype, tuple(space.shape or ()))
        if space.shape != self.shape:
            values = graph.reshaped(values, self.shape)
        if self.first is not None and self.first.any():
            values = graph.add("Sub", values, graph.constant(self.first, np.int64))
        return values

    @property
    def _where(self) -> str:
        return f" in component {self.leaf.name!r}" if self.leaf.path else ""

    def _outside(self, values: np.ndarray) -> EnvironmentSetupError:
        return EnvironmentSetupError(
            f"the environment returned an observation outside its space{self._where}: "
            f"{described(values)} for {described(self.leaf.space)}"
        )

    def _fitted(self, values: np.ndarray) -> np.ndarray:
        """Return a batch, of a vector environment that did not make it by its spaces, in the dtype of the space."""
        shape = self.leaf.space.shape or ()
        if not values.ndim or [each for each in values.shape[1:] if each != 1] != [each for each in shape if each != 1]:
            raise EnvironmentSetupError(
                f"the environment returned a batch of observations of shape {values.shape}{self._where}, but after the "
                f"number of environments it must have shape {shape}, as {described(self.leaf.space)}"
            )
        values = values.reshape(len(values), *shape)
        if misfit := dtype_misfit(self.leaf.space, values):
            raise EnvironmentSetupError(
                f"the environment returned an observation outside its space{self._where}: it {misfit}"
            )
        with np.errstate(all="ignore"):
            return values.astype(self.leaf.space.dtype)


def observation_components(space: gymnasium.Space) -> tuple[ObservationComponent, ...]:
    """Return the components of an observation space. Raises EnvironmentSetupError for a space without any."""
    kept = [leaf for leaf in leaves(space, "observation") if not isinstance(leaf.space, LeftOut)]
    if not kept:
        raise EnvironmentSetupError("environment.leave_out names every component of the observation: keep one")
    return tuple(_observation(leaf) for leaf in kept)


def _observation(leaf: Leaf) -> ObservationComponent:
    match leaf.space:
        case gym.Box() | gym.MultiBinary():
            shape = tuple(leaf.space.shape or ()) or (1,)
            if len(shape) > _MAX_DIMENSIONS or 0 in shape:
                raise unsupported("observation", leaf)
            return ObservationComponent(leaf, shape, None)
        case gym.Discrete() as space:
            return ObservationComponent(leaf, (1,), np.array([space.start]), (int(space.n),))
        case gym.MultiDiscrete() as space:
            counts = tuple(int(count) for count in space.nvec.ravel())
            return ObservationComponent(leaf, (len(counts),), space.start.ravel(), counts)
        case _:
            raise unsupported("observation", leaf)


# ----------------------------------------------------------------------------------------------------- actions


class ActionComponents:
    """The components of an action space, and the environment's actions for their values."""

    def __init__(self, space: gymnasium.Space) -> None:
        """Raises EnvironmentSetupError if the space is not supported."""
        self._space, self._leaves = space, leaves(space, "action")
        try:
            self.spaces: dict[str, ActionSpace] = {leaf.name: self._component(leaf) for leaf in self._leaves}
        except ValidationError as error:
            raise EnvironmentSetupError(
                f"action space {described(space)} is not supported: {reason_of(error)}"
            ) from None
        self._bounded = {
            leaf.name: BoundedActions(leaf.space) for leaf in self._leaves if isinstance(leaf.space, gym.Box)
        }

    @property
    def first_choices(self) -> dict[str, np.ndarray]:
        """First choice of each variable of the components that are gymnasium's Discrete or MultiDiscrete."""
        return {
            leaf.name: np.ravel(leaf.space.start)
            for leaf in self._leaves
            if isinstance(leaf.space, gym.Discrete | gym.MultiDiscrete)
        }

    def env_actions(self, values: dict[str, np.ndarray]) -> Any:
        """Return the environment's batched actions for values {name: [E, D]} of all components."""
        parts = {leaf.path: self._env_action(leaf, values[leaf.name]) for leaf in self._leaves}
        return nested(self._space, (), parts)

    def policy_actions(self, actions: Any) -> dict[str, np.ndarray]:
        """Return the values {name: [E, D]} of the environment's batched actions: the inverse of `env_actions`.

        Raises ValueError for an action outside its space.
        """
        return {leaf.name: self._policy_action(leaf, leaf.of(actions)) for leaf in self._leaves}

    def _policy_action(self, leaf: Leaf, actions: np.ndarray) -> np.ndarray:
        shape = leaf.space.shape or ()
        if actions.shape[1:] != shape or actions.dtype.kind not in "biuf":
            raise ValueError(f"actions {described(actions)} do not fit {described(leaf.space)}")
        if isinstance(leaf.space, gym.Box):
            return self._bounded[leaf.name].values(actions)
        flat = actions.reshape(len(actions), -1)
        start = np.ravel(getattr(leaf.space, "start", 0))
        component = self.spaces[leaf.name]
        assert isinstance(component, DiscreteSpace)
        choices = np.clip(flat, -(2**62), 2**62).astype(np.int64) - start
        wrong = (choices + start != flat) | (choices < 0) | (choices >= np.array(component.counts))
        if wrong.any():
            raise ValueError(f"the action {flat[wrong][0]:g} is outside {described(leaf.space)}")
        return choices.astype(component.dtype)

    def add_outputs(self, graph: "OnnxGraph", values: Mapping[str, str]) -> None:
        """Add what `env_actions` does to an ONNX graph, with one output for each component."""
        for leaf in self._leaves:
            value, space = values[leaf.name], leaf.space
            if isinstance(space, gym.Box):
                value = graph.cast(self._bounded[leaf.name].exported(graph, value), exported_dtype(space))
            elif isinstance(space, gym.Discrete | gym.MultiDiscrete) and np.any(space.start):
                value = graph.add("Add", value, graph.constant(np.ravel(space.start), np.int64))
            graph.output(leaf.name, value, exported_dtype(space), tuple(space.shape or ()))

    def _component(self, leaf: Leaf) -> ActionSpace:
        match leaf.space:
            case gym.Discrete() as space:
                _check_choices(space, np.array(int(space.start) + int(space.n) - 1))
                return DiscreteSpace(counts=(int(space.n),))
            case gym.MultiDiscrete() as space:
                _check_choices(space, space.start.astype(np.int64) + space.nvec.astype(np.int64) - 1)
                return DiscreteSpace(counts=tuple(int(count) for count in space.nvec.ravel()))
            case gym.MultiBinary() as space:
                return DiscreteSpace(counts=(2,) * int(np.prod(space.shape)))
            case gym.Box() as space if space.dtype is not None and space.dtype.kind in "fiu" and 0 not in space.shape:
                return continuous_space(space)
            case _:
                raise unsupported("action", leaf)

    def _env_action(self, leaf: Leaf, values: np.ndarray) -> np.ndarray:
        match leaf.space:
            case gym.Discrete() as space:
                choices = values[:, 0] + space.start if space.start else values[:, 0]
                return choices.astype(space.dtype)
            case gym.MultiDiscrete() as space:
                return (values + space.start.ravel()).reshape(len(values), *space.shape).astype(space.dtype)
            case gym.Box():
                return self._bounded[leaf.name].of(values)
            case space:
                return values.reshape(len(values), *(space.shape or ())).astype(space.dtype)


def _check_choices(space: gymnasium.Space, last: np.ndarray) -> None:
    """Raise EnvironmentSetupError if the dtype of a space cannot hold its last choices."""
    if misfit := dtype_misfit(space, last):
        raise EnvironmentSetupError(f"action space {described(space)} {misfit}: give it a wider dtype")


def nested(space: gymnasium.Space, path: tuple[str | int, ...], parts: dict[tuple[str | int, ...], Any]) -> Any:
    """Return a value of a nested space from those of its leaves, by the keys and indices that lead to them."""
    if isinstance(space, gym.Dict):
        return {key: nested(part, (*path, key), parts) for key, part in space.spaces.items()}
    if isinstance(space, gym.Tuple):
        return tuple(nested(part, (*path, index), parts) for index, part in enumerate(space.spaces))
    return parts[path]


# ------------------------------------------------------------------------------------------- batches of one


def batch_of_one(space: gymnasium.Space, value: Any, where: str = "the observation") -> Any:
    """Return a value of a nested space with a first axis of 1 in each component; None for a part that is left out.

    Raises ValueError, naming the component, if it is not a finite value of the space.
    """
    if isinstance(space, LeftOut):
        return None
    if isinstance(space, gym.Dict):
        parts = {key: part for key, part in space.spaces.items() if not isinstance(part, LeftOut)}
        missing = [key for key in parts if not isinstance(value, Mapping) or key not in value]
        if missing:
            raise ValueError(f"{where} lacks {missing[0]!r}: its space has {', '.join(map(str, parts))}")
        return {key: batch_of_one(part, value[key], f"{where}[{key!r}]") for key, part in parts.items()}
    if isinstance(space, gym.Tuple):
        if not isinstance(value, Sequence) or len(value) != len(space.spaces):
            raise ValueError(f"{where} must be a tuple of {len(space.spaces)} components")
        return tuple(batch_of_one(part, value[i], f"{where}[{i}]") for i, part in enumerate(space.spaces))
    array = np.asarray(value)
    if array.shape != space.shape:
        raise ValueError(f"{where} has shape {array.shape}, but its space has shape {space.shape}")
    converted = _converted(space, array, where)
    if not isinstance(space, gym.Box) and not space.contains(converted):
        raise ValueError(f"{where} is {value}, which is outside {described(space)}")
    return converted[None]


def _converted(space: gymnasium.Space, array: np.ndarray, where: str) -> np.ndarray:
    """Return an array in the dtype of its space. Raises ValueError if that would change it."""
    with np.errstate(all="ignore"):
        if array.dtype.kind == "f" and not np.isfinite(seen := array.astype(np.float32)).all():  # as the policy sees it
            raise ValueError(f"{where} has a value that is not finite ({array[~np.isfinite(seen)].flat[0]:g})")
        if misfit := dtype_misfit(space, array):
            raise ValueError(f"{where} {misfit}: pass it as the environment returns it")
        return array.astype(space.dtype)


def dtype_misfit(space: gymnasium.Space, array: np.ndarray) -> str:
    """Return which number the dtype of a space would change, or an empty string. Floats are only rounded."""
    if array.dtype == space.dtype or space.dtype is None:
        return ""
    if array.dtype.kind not in "biuf":
        return f"has dtype {array.dtype}: it must have numbers, of dtype {space.dtype}"
    if space.dtype.kind == "f":
        return ""
    with np.errstate(all="ignore"):
        changed = array.astype(space.dtype) != array
    return f"has the value {array[changed].flat[0]:g}, but its space has dtype {space.dtype}" if changed.any() else ""


def only_of_batch(space: gymnasium.Space, batch: Any, row: int = 0) -> Any:
    """Return one value of a batch, of one by default, as the nested space has it."""
    if isinstance(space, gym.Dict):
        return {key: only_of_batch(part, batch[key], row) for key, part in space.spaces.items()}
    if isinstance(space, gym.Tuple):
        return tuple(only_of_batch(part, batch[index], row) for index, part in enumerate(space.spaces))
    return batch[row]


def stacked(space: gymnasium.Space, values: Sequence[Any]) -> Any:
    """Return values of a nested space as a batch."""
    parts = {leaf.path: np.stack([leaf.of(value) for value in values]) for leaf in leaves(space, "action")}
    return nested(space, (), parts)


AGENT = "agent"  # component of the observation with environment.agent_ids


def with_agent(space: gymnasium.Space, agents: int) -> gymnasium.spaces.Dict:
    """Return an observation space with the number of the agent. Raises EnvironmentSetupError if it has one."""
    parts = dict(space.spaces) if isinstance(space, gymnasium.spaces.Dict) else {"observation": space}
    if AGENT in parts:
        raise EnvironmentSetupError(
            f"the observation has a component {AGENT!r} of its own: leave environment.agent_ids unset"
        )
    return gymnasium.spaces.Dict({**parts, AGENT: gymnasium.spaces.Discrete(agents)})


def numbered(observation: Any, number: int) -> dict[str, Any]:
    """Return an observation of `with_agent`, of the agent with a number."""
    parts = observation if isinstance(observation, Mapping) else {"observation": observation}
    return {**parts, AGENT: number}
