"""The spaces of observations and actions, as they travel."""

from typing import Annotated, Literal

from pydantic import Field

from daedalus.protocol.specification import PositiveInt, Specification


class ArraySpace(Specification):
    """Arrays of one shape and dtype (gymnasium's Box), as they travel: `float32` or `uint8`.

    An environment shows one frame at a step; the policy sees the newest `frames` of them, stacked on a first axis of
    their own where there is more than one.
    """

    kind: Literal["array"] = "array"
    shape: Annotated[tuple[PositiveInt, ...], Field(min_length=1, max_length=4)]  # of one frame
    dtype: Literal["float32", "uint8"]
    frames: Annotated[int, Field(ge=1, le=16)] = 1

    @property
    def stacked_shape(self) -> tuple[int, ...]:
        """The shape that the policy sees."""
        return self.shape if self.frames == 1 else (self.frames, *self.shape)

    def __str__(self) -> str:
        stacked = f", {self.frames} stacked" if self.frames > 1 else ""
        return f"{self.dtype} array of shape {self.shape}{stacked}"


class DiscreteSpace(Specification):
    """One of `count` choices, numbered from 0 (gymnasium's Discrete, its `start` taken away)."""

    kind: Literal["discrete"] = "discrete"
    count: Annotated[int, Field(ge=1, le=65_536)]

    def __str__(self) -> str:
        return f"{self.count} choices"


class Spaces(Specification):
    """What an environment shows and what it can be told; the actor finds them, the learner holds all to them."""

    observation: ArraySpace
    action: DiscreteSpace

    def __str__(self) -> str:
        return f"observation: {self.observation}; action: {self.action}"
