"""The spaces of observations and actions in messages."""

import math
from typing import Annotated, Literal

from pydantic import Field, model_validator

from daedalus.protocol.specification import PositiveInt, Specification

_MAX_OBSERVATION_BYTES = 64 << 20  # actors report their spaces, and the learner allocates batches of that size


class ArraySpace(Specification):
    """Arrays of one shape and dtype (gymnasium's Box): `float32` or `uint8`.

    An environment returns one frame per step; the policy observes the newest `frames` frames, stacked on a new first
    axis if there are several.
    """

    kind: Literal["array"] = "array"
    shape: Annotated[tuple[PositiveInt, ...], Field(min_length=1, max_length=4)]  # of one frame
    dtype: Literal["float32", "uint8"]
    frames: Annotated[int, Field(ge=1, le=16)] = 1

    @model_validator(mode="after")
    def _fits_in_memory(self) -> "ArraySpace":
        size = math.prod(self.stacked_shape) * (4 if self.dtype == "float32" else 1)
        if size > _MAX_OBSERVATION_BYTES:
            raise ValueError(f"an observation of {self} has {size:,} bytes: use at most {_MAX_OBSERVATION_BYTES:,}")
        return self

    @property
    def stacked_shape(self) -> tuple[int, ...]:
        """Shape of the policy's observations."""
        return self.shape if self.frames == 1 else (self.frames, *self.shape)

    def __str__(self) -> str:
        stacked = f", {self.frames} stacked" if self.frames > 1 else ""
        return f"{self.dtype} array of shape {self.shape}{stacked}"


class DiscreteSpace(Specification):
    """Space of `count` choices, numbered from 0: gymnasium's Discrete with `start` subtracted."""

    kind: Literal["discrete"] = "discrete"
    count: Annotated[int, Field(ge=1, le=65_536)]

    def __str__(self) -> str:
        return f"{self.count} choices"


class Spaces(Specification):
    """Observation and action space of an environment; actors report them, and the learner checks that all agree."""

    observation: ArraySpace
    action: DiscreteSpace

    def __str__(self) -> str:
        return f"observation: {self.observation}; action: {self.action}"
