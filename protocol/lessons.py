"""Lessons: the settings by which the learner varies parameters of the environment in training, and what actors draw.

A lesson is about one parameter. The true task has one value for it (`environment.parameters`), which evaluations play.
An actor draws the value of each episode from the newest plan that it has, so that it needs no answer of the learner.
"""

import numbers
import re
from collections.abc import Mapping
from typing import Annotated, Literal

from pydantic import AfterValidator, Field, PlainSerializer, PlainValidator, model_validator

from daedalus.protocol.models import PositiveInt, Specification

MAX_LESSONS = 16  # parameters of one run
MAX_RANGES = 64  # of one parameter
_LARGEST = 1e15  # whole numbers up to it are exact in float64


def _number(value: object) -> int | float:
    if isinstance(value, numbers.Real) and not isinstance(value, bool):  # also numpy's scalars
        number = int(value) if isinstance(value, numbers.Integral) else float(value)
        if abs(number) <= _LARGEST:
            return number
    raise ValueError(f"must be a number from -{_LARGEST:g} to {_LARGEST:g}")


def _parameter_name(value: str) -> str:
    if re.fullmatch(r"[A-Za-z][A-Za-z0-9_]{0,63}", value) is None:
        raise ValueError("must be the name of a parameter, of letters, digits and _")
    return value


Number = Annotated[float, PlainValidator(_number), PlainSerializer(lambda value: value)]
ParameterName = Annotated[str, AfterValidator(_parameter_name)]
Parameters = Mapping[str, int | float]


class LessonSpec(Specification):
    """How one parameter varies in training. Use one of the three ways: `start`, `steps` or `between`."""

    start: Number | None = None
    """Value at the start of training. It changes linearly to that of the true task."""
    until_env_steps: PositiveInt | None = None
    """With `start`: from this many env_steps on, training plays the true task."""

    steps: Annotated[tuple[Number, ...], Field(min_length=1, max_length=MAX_RANGES)] | None = None
    """Values to play one after the other; after the last one comes the true task."""
    above: Number | None = None
    """With `steps`: go to the next value when the mean return of the last `training.target_episodes` episodes with the
    present value is at least this."""

    between: tuple[Number, Number] | None = None
    """Lowest and highest value: each episode draws its own."""
    where: Literal["everywhere", "progress"] = "everywhere"
    """With `between`: draw uniformly, or more often from the parts of the range where the mean return changes most."""

    @model_validator(mode="after")
    def _is_one_way(self) -> "LessonSpec":
        ways = [name for name in ("start", "steps", "between") if getattr(self, name) is not None]
        if len(ways) != 1:
            raise ValueError("must have one of start, steps and between")
        for name, way in (("until_env_steps", "start"), ("above", "steps")):
            if (getattr(self, name) is None) is (ways == [way]):
                raise ValueError(f"must have {way} and {name} together")
        if self.where != "everywhere" and self.between is None:
            raise ValueError(f"must have where={self.where} and between together")
        if self.between is not None and not self.between[0] < self.between[1]:
            raise ValueError("must have a lower and then a higher value in between")
        return self

    @property
    def values(self) -> tuple[int | float, ...]:
        """The numbers that the settings name: those that are played lie among them or between them."""
        return (self.start,) if self.start is not None else self.steps or self.between or ()


Lessons = Annotated[dict[ParameterName, LessonSpec], Field(max_length=MAX_LESSONS)]


def check_lessons(lessons: Mapping[str, LessonSpec], true_task: Parameters) -> None:
    """Raise ValueError for a lesson that does not end at a value of the true task."""
    for name, lesson in lessons.items():
        if name not in true_task:
            raise ValueError(
                f"lessons.{name} is set, but the true task has no value for {name}: set environment.parameters.{name}, "
                "which evaluations play and where lessons end"
            )
        fraction = next((value for value in lesson.values if isinstance(value, float)), None)
        if isinstance(true_task[name], int) and fraction is not None:
            raise ValueError(
                f"lessons.{name} has {fraction}, but environment.parameters.{name} is the whole number "
                f"{true_task[name]}, so that all values are whole: write {true_task[name]}.0 there"
            )


def extremes(lessons: Mapping[str, LessonSpec], true_task: Parameters) -> list[dict[str, int | float]]:
    """Return parameters to try before a run: the true task, and each value that the settings of a lesson name."""
    longest = max((len(lesson.values) for lesson in lessons.values()), default=0)
    tried = [dict(true_task)]
    for index in range(longest):
        values = {name: lesson.values[min(index, len(lesson.values) - 1)] for name, lesson in lessons.items()}
        tried.append({**true_task, **{name: as_true(true_task[name], value) for name, value in values.items()}})
    return tried


def as_true(true_value: int | float, value: float) -> int | float:
    """Return a value as the environment gets it: whole where that of the true task is, else a float."""
    return round(value) if isinstance(true_value, int) else float(value)


class LessonRange(Specification):
    """Part of the values of a parameter, drawn from uniformly, both ends included. A single value has equal ends."""

    low: float
    high: float
    weight: Annotated[float, Field(gt=0.0)] = 1.0  # in proportion to the probability of this range


class LessonPlan(Specification):
    """From which ranges actors draw each parameter that has a lesson. Learner -> actor, with a snapshot."""

    ranges: Annotated[
        dict[ParameterName, Annotated[tuple[LessonRange, ...], Field(min_length=1, max_length=MAX_RANGES)]],
        Field(max_length=MAX_LESSONS),
    ]
