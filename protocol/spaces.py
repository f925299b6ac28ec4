"""The spaces of observations and actions in messages: flat maps of named components.

The environment's nested spaces are flattened to components, and actions back (actor/environments/components.py).
"""

import math
from collections.abc import Mapping, Sequence
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import FailFast, Field, StringConstraints, field_validator, model_validator

from daedalus.protocol.models import PositiveInt, Specification

LARGEST_OBSERVATION = 1e15  # of a number in an observation: beyond it squares overflow float32
LARGEST_REWARD = 1e9  # as learning sees it: the learner (learner/serving/rollout_judge.py) rejects larger ones
_FEWEST_ROWS, _FEWEST_EPISODES = 50, 3  # after which an observation that does not change is a fault
_MAX_OBSERVATION_BYTES = 64 << 20  # actors report their spaces, and the learner allocates batches of that size
_MAX_CHOICES = 65_536  # of a space over all its variables: the policy has an output for each
_MAX_COMPONENTS = 64
_REPLAY_BYTES = 24  # of a row in a replay buffer: its reward, flags, age, and index among the rows, rounded up
_MAX_VARIABLES = 8_192  # of all discrete and continuous components together: a Join lists their bounds


def unfit_number(values: np.ndarray) -> str:
    """Return why no policy can act on, or learn from, numbers of an observation; empty if there is nothing wrong.

    Actors, clients, evaluations and the learner refuse observations by this rule.
    """
    if values.dtype.kind != "f" or not values.size:
        return ""
    low, high = values.min(), values.max()  # nan if there is a nan
    if -LARGEST_OBSERVATION <= low and high <= LARGEST_OBSERVATION:
        return ""
    if not (np.isfinite(low) and np.isfinite(high)):
        return f"has a value that is not finite ({values[~np.isfinite(values)][0]})"
    beyond = low if low < -LARGEST_OBSERVATION else high
    return f"has a value beyond +-{LARGEST_OBSERVATION:g}: scale or clip the observations (it is {beyond:g})"


class StillObservations:
    """What of the observations has not changed so far: all of a game that draws nothing, a camera that stands still."""

    def __init__(self) -> None:
        # By component: at all, also from one episode, environment or agent to the next.
        self._changed: dict[str, bool] = {}
        self._moves = False  # whether anything changed within an episode
        self._compared = 0  # rows that go on

    def add(self, frames: Mapping[str, np.ndarray], goes_on: np.ndarray) -> None:
        """Look at rows that follow each other.

        Args:
          frames: components [T+1, E, ...].
          goes_on: [T, E], whether the row after is of the same episode, and not its last.
        """
        self._compared += int(goes_on.sum())
        for name, rows in frames.items():
            if not (self._moves and self._changed.get(name, False)):
                differs = (rows[1:] != rows[:-1]).reshape(*goes_on.shape, -1).any(2)
                self._changed[name] = self._changed.get(name, False) or bool(
                    differs.any() or (rows[0] != rows[0, :1]).any()
                )
                self._moves |= bool((differs & goes_on).any())

    def text(self, episodes: int) -> str:
        """Return what is wrong after so many episodes, with what to do; empty if nothing is, or it is too early."""
        if self._compared < _FEWEST_ROWS:
            return ""
        if not self._moves:
            return (
                f"the observation has changed in none of {self._compared:,} rows within an episode, so that the policy "
                "cannot see what happens: look at what it comes from. Some environments draw their pictures only with "
                "--set environment.kwargs.render_mode=rgb_array"
            )
        still = [name for name, changed in self._changed.items() if not changed]
        if not still or episodes < _FEWEST_EPISODES:
            return ""
        return (
            f"observation component {still[0]!r} is the same in all {self._compared:,} rows and {episodes:,} episodes "
            "so far: if it should have changed by now, look at the sensor or camera that it comes from"
        )


def unfit_code(values: np.ndarray, codes: Sequence[int]) -> str:
    """Return which value of an observation [..., C] is no code of its place in the last axis; empty if all are.

    Args:
      values: bytes of one component.
      codes: how many codes each place has [C]; see policy.codes.
    """
    largest = values.max(axis=tuple(range(values.ndim - 1)), initial=0)
    unknown = np.flatnonzero(largest >= np.array(codes))
    if not len(unknown):
        return ""
    place = unknown[0]
    return (
        f"has the value {largest[place]} in place {place} of its last axis, but policy.codes has {codes[place]} codes "
        "there: correct the environment, or start a run with higher numbers in policy.codes, or policy.codes=none"
    )


ComponentName = Annotated[str, StringConstraints(pattern=r"^[\w.-]{1,64}$")]


def colours_last(shape: tuple[int, ...]) -> bool:
    """Return whether an image is (height, width, colours); else (colours, height, width), or (height, width) alone.

    If only two neighbouring axes of the three are equal, they are the height and the width: a board may have more
    planes than rows. Else the colours are on the shorter of the first and the last axis.
    """
    if len(shape) != 3:
        return False
    first, middle, last = shape
    return last < first if (first == middle) == (middle == last) else first == middle


class ArraySpace(Specification):
    """Arrays of one shape and dtype (gymnasium's Box): `float32` or `uint8`.

    An environment returns one frame per step; the policy observes the newest `frames` frames, stacked on a new first
    axis if there are several.
    """

    kind: Literal["array"] = "array"
    shape: Annotated[tuple[PositiveInt, ...], Field(min_length=1, max_length=4), FailFast()]  # of one frame
    dtype: Literal["float32", "uint8"]
    frames: Annotated[int, Field(ge=1, le=16)] = 1

    @model_validator(mode="after")
    def _fits_in_memory(self) -> "ArraySpace":
        if self.observation_bytes > _MAX_OBSERVATION_BYTES:
            raise ValueError(
                f"an observation of {self} has {self.observation_bytes:,} bytes: use at most {_MAX_OBSERVATION_BYTES:,}"
            )
        return self

    @property
    def stacked_shape(self) -> tuple[int, ...]:
        """Shape of the policy's observations."""
        return self.shape if self.frames == 1 else (self.frames, *self.shape)

    @property
    def observation_bytes(self) -> int:
        """Size of one stacked observation."""
        return self.frames * self.frame_bytes

    @property
    def frame_bytes(self) -> int:
        """Size of one frame."""
        return math.prod(self.shape) * (4 if self.dtype == "float32" else 1)

    @property
    def image_shape(self) -> tuple[int, int, int]:
        """Colours, height and width of a frame of two or three dimensions."""
        first, height, width = (1, *self.shape) if len(self.shape) == 2 else self.shape
        return (width, first, height) if colours_last(self.shape) else (first, height, width)

    @property
    def is_image(self) -> bool:
        """Whether a frame is an image: bytes in two or three dimensions, at least 16 pixels high and wide."""
        return self.dtype == "uint8" and len(self.shape) in (2, 3) and min(self.image_shape[1:]) >= 16

    def __str__(self) -> str:
        stacked = f", {self.frames} stacked" if self.frames > 1 else ""
        return f"{self.dtype} array of shape {self.shape}{stacked}"


class DiscreteSpace(Specification):
    """D variables, each with a number of choices counted from 0: gymnasium's Discrete, MultiDiscrete and MultiBinary.

    Values are integers [D].
    """

    kind: Literal["discrete"] = "discrete"
    counts: Annotated[
        tuple[Annotated[int, Field(ge=1, le=_MAX_CHOICES)], ...], Field(min_length=1, max_length=4096), FailFast()
    ]
    masked: bool = False  # an action space whose legal choices come with each observation

    @model_validator(mode="after")
    def _has_few_choices(self) -> "DiscreteSpace":
        if self.choices > _MAX_CHOICES:
            raise ValueError(f"{self} are {self.choices:,} choices together: use at most {_MAX_CHOICES:,}")
        return self

    @property
    def choices(self) -> int:
        """Number of choices of all variables together: the size of a mask, and of a one-hot encoding."""
        return sum(self.counts)

    @property
    def size(self) -> int:
        """D, the number of variables."""
        return len(self.counts)

    @property
    def shape(self) -> tuple[int, ...]:
        """Shape of a value, [D]. As an observation it has no frame stack."""
        return (len(self.counts),)

    @property
    def frames(self) -> int:
        """Number of frames that the policy observes: the newest."""
        return 1

    @property
    def stacked_shape(self) -> tuple[int, ...]:
        """Shape of the policy's observations."""
        return self.shape

    @property
    def dtype(self) -> Literal["uint8", "uint16"]:
        """Data type of values in messages."""
        return "uint8" if max(self.counts) <= 256 else "uint16"

    @property
    def frame_bytes(self) -> int:
        """Size of a value in messages."""
        return len(self.counts) * (1 if self.dtype == "uint8" else 2)

    def __str__(self) -> str:
        masked = ", masked" if self.masked else ""
        if self.size == 1:
            return f"{self.counts[0]} choices{masked}"
        listed = " x ".join(map(str, self.counts)) if self.size <= 8 else f"{self.size} variables"
        return f"choices of {listed}{masked}"


class ContinuousSpace(Specification):
    """D continuous actions with optional bounds: gymnasium's Box, flattened.

    In messages, an action with both bounds is scaled to [-1, 1]; any other is as the environment has it. Bounds and
    values are float32 [D]. Values may lie outside the bounds: an actor clips them before the environment
    receives them. Two equal bounds are the only value of their action, whatever the message says.
    """

    kind: Literal["continuous"] = "continuous"
    low: Annotated[tuple[float | None, ...], Field(min_length=1, max_length=4096), FailFast()]
    high: Annotated[tuple[float | None, ...], Field(min_length=1, max_length=4096), FailFast()]

    @field_validator("low", "high")
    @classmethod
    def _as_float32(cls, bounds: tuple[float | None, ...]) -> tuple[float | None, ...]:
        """Round bounds as values are: an environment has them in float64 and its client, or its copy, in float32."""
        with np.errstate(over="ignore"):
            return tuple(None if bound is None else float(np.float32(bound)) for bound in bounds)

    @model_validator(mode="after")
    def _bounds_agree(self) -> "ContinuousSpace":
        if len(self.low) != len(self.high):
            raise ValueError(f"{len(self.low)} lower bounds, but {len(self.high)} upper bounds")
        for low, high in zip(self.low, self.high, strict=True):
            if not all(bound is None or math.isfinite(bound) for bound in (low, high)):
                raise ValueError("a bound is not finite in float32: leave it out")
            if low is not None and high is not None and low > high:
                raise ValueError(f"the lower bound {low:g} is above the upper bound {high:g}: exchange them")
        return self

    @property
    def size(self) -> int:
        """D, the number of actions."""
        return len(self.low)

    @property
    def bounded(self) -> bool:
        """Whether every action has both bounds."""
        return None not in self.low and None not in self.high

    def limits(self, dtype: type[np.floating] = np.float32) -> tuple[np.ndarray, np.ndarray]:
        """Return the lowest and the highest values [D], infinite without a bound."""
        low = [-np.inf if bound is None else bound for bound in self.low]
        high = [np.inf if bound is None else bound for bound in self.high]
        return np.array(low, dtype), np.array(high, dtype)

    @property
    def dtype(self) -> Literal["float32"]:
        """Data type of values in messages."""
        return "float32"

    def __str__(self) -> str:
        bounds = sorted({(low, high) for low, high in zip(self.low, self.high, strict=True)}, key=str)
        if len(bounds) > 1:
            return f"{self.size} continuous"
        low, high = bounds[0]
        return f"{self.size} continuous from {'-inf' if low is None else f'{low:g}'} to " + (
            "inf" if high is None else f"{high:g}"
        )


ObservationSpace = Annotated[ArraySpace | DiscreteSpace, Field(discriminator="kind")]
ObservationSpaces = dict[str, ArraySpace | DiscreteSpace]  # by component
ActionSpace = Annotated[DiscreteSpace | ContinuousSpace, Field(discriminator="kind")]


class ComponentOrder(Specification):
    """The order in which a network reads and returns the components of spaces: places among their sorted names."""

    observations: Annotated[tuple[int, ...], Field(max_length=_MAX_COMPONENTS)]
    actions: Annotated[tuple[int, ...], Field(max_length=_MAX_COMPONENTS)]


class Spaces(Specification):
    """Observation and action space of an environment; actors report them, and the learner checks that all agree.

    A space that is not composite has one component, `observation` or `action`.
    """

    observations: Annotated[dict[ComponentName, ObservationSpace], Field(min_length=1, max_length=_MAX_COMPONENTS)]
    actions: Annotated[dict[ComponentName, ActionSpace], Field(min_length=1, max_length=_MAX_COMPONENTS)]

    @model_validator(mode="after")
    def _fits_in_memory(self) -> "Spaces":
        arrays = [space for space in self.observations.values() if isinstance(space, ArraySpace)]
        size = sum(space.observation_bytes for space in arrays)
        if size > _MAX_OBSERVATION_BYTES:
            raise ValueError(f"an observation has {size:,} bytes: use at most {_MAX_OBSERVATION_BYTES:,}")
        outputs = sum(
            space.choices if isinstance(space, DiscreteSpace) else space.size for space in self.actions.values()
        )
        if outputs > _MAX_CHOICES:
            raise ValueError(f"an action has {outputs:,} choices and numbers together: use at most {_MAX_CHOICES:,}")
        listed = [*self.observations.values(), *self.actions.values()]
        variables = sum(space.size for space in listed if not isinstance(space, ArraySpace))
        if variables > _MAX_VARIABLES:
            raise ValueError(f"the spaces have {variables:,} variables together: use at most {_MAX_VARIABLES:,}")
        return self

    @property
    def masks(self) -> dict[str, int]:
        """Number of choices in the mask of each masked action component."""
        return {name: space.choices for name, space in self.discrete_actions.items() if space.masked}

    @property
    def order(self) -> ComponentOrder:
        """The order of the components, which equal spaces may list in another one."""
        listed = [*self.observations], [*self.actions]
        observations, actions = (tuple(map(sorted(names).index, names)) for names in listed)
        return ComponentOrder(observations=observations, actions=actions)

    def in_order(self, order: ComponentOrder) -> "Spaces":
        """Return the same spaces with their components in an order. Raises ValueError if it has other components."""
        update: dict[str, Any] = {}
        for kind in ("observations", "actions"):
            spaces, places = getattr(self, kind), getattr(order, kind)
            if sorted(places) != list(range(len(spaces))):
                raise ValueError(f"{list(places)} is no order of {len(spaces)} {kind}")
            names = sorted(spaces)
            update[kind] = {names[place]: spaces[names[place]] for place in places}
        return self.model_copy(update=update)

    @property
    def discrete_actions(self) -> dict[str, DiscreteSpace]:
        """The components of the action that are choices."""
        return {name: space for name, space in self.actions.items() if isinstance(space, DiscreteSpace)}

    @property
    def continuous_numbers(self) -> int:
        """How many numbers of an action are continuous."""
        return sum(space.size for space in self.actions.values() if isinstance(space, ContinuousSpace))

    @property
    def only_choice(self) -> DiscreteSpace | None:
        """The action, if it is one discrete choice, masked or not; else None."""
        first, *others = self.actions.values()
        return first if isinstance(first, DiscreteSpace) and first.size == 1 and not others else None

    @property
    def fits_replay(self) -> bool:
        """Whether `sac` can learn the actions: all are continuous with both bounds, or there is one unmasked choice."""
        if self.only_choice is not None:
            return not self.only_choice.masked
        return all(isinstance(space, ContinuousSpace) and space.bounded for space in self.actions.values())

    def without_masks(self) -> "Spaces":
        """Return the same spaces whose choices are all legal."""
        actions = {
            name: space.model_copy(update={"masked": False}) if isinstance(space, DiscreteSpace) else space
            for name, space in self.actions.items()
        }
        return self.model_copy(update={"actions": actions})

    def frame_bytes(self, rows: int) -> int:
        """Return the size of the frames of some rows of one environment, with those before and after them."""
        return sum((space.frames + rows) * space.frame_bytes for space in self.observations.values())

    def replay_bytes(self, rows: int) -> int:
        """Return the memory of some rows of one environment in a replay buffer (algorithms/replay_buffer.py)."""
        return self.frame_bytes(rows) + rows * (4 * sum(space.size for space in self.actions.values()) + _REPLAY_BYTES)

    @property
    def listed_actions(self) -> str:
        """The components of the action in words."""
        return _listed(self.actions)

    def __str__(self) -> str:
        return f"observation: {_listed(self.observations)}; action: {self.listed_actions}"


def _listed(components: dict[str, ArraySpace | DiscreteSpace] | dict[str, DiscreteSpace | ContinuousSpace]) -> str:
    if len(components) == 1 and next(iter(components)) in ("observation", "action"):
        return str(next(iter(components.values())))
    return ", ".join(f"{name}: {space}" for name, space in components.items())
