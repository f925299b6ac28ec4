"""The parameters that episodes are played with in a run with lessons. No network, no threads."""

from collections.abc import Callable

import numpy as np

from daedalus.protocol.lessons import LessonPlan, LessonRange, Parameters, as_true, extremes
from daedalus.protocol.spec import ActorSpec


class LessonDraws:
    """Draws the parameters of episodes from the newest plan of the learner.

    Attributes:
      true_task: the parameters that evaluations play.
      plan: from which to draw; empty: the true task, until a plan has come.
    """

    def __init__(self, spec: ActorSpec, random: np.random.Generator) -> None:
        """Construct from the run, whose lessons these are, and the source of random numbers."""
        self.true_task, self._names = spec.environment.parameters, sorted(spec.lessons)
        self._random, self.plan = random, LessonPlan(ranges={})

    def draw(self) -> dict[str, int | float]:
        """Return the parameters of an episode."""
        drawn: dict[str, int | float] = dict(self.true_task)
        for name in self._names:
            if ranges := self.plan.ranges.get(name):
                drawn[name] = self._one(self.true_task[name], ranges)
        return drawn

    def with_lessons(self, parameters: Parameters) -> Parameters:
        """Return those of an episode's parameters that have a lesson; rollouts tell the learner of these alone."""
        return {name: parameters[name] for name in self._names}

    def _one(self, true_value: int | float, ranges: tuple[LessonRange, ...]) -> int | float:
        chosen = ranges[0]
        if len(ranges) > 1:
            bounds = np.cumsum([each.weight for each in ranges])
            chosen = ranges[int(np.searchsorted(bounds[:-1], self._random.random() * bounds[-1], side="right"))]
        low, high = chosen.low, chosen.high
        if low == high:
            return as_true(true_value, low)
        if isinstance(true_value, int):
            return int(self._random.integers(round(low), round(high), endpoint=True))
        return float(self._random.uniform(low, high))


def lesson_arrays(episodes: list[Parameters]) -> dict[str, np.ndarray]:
    """Return the parameters with lessons of K episodes, {name: [K] float64}; empty without episodes."""
    names = episodes[0] if episodes else ()
    return {name: np.array([each[name] for each in episodes], np.float64) for name in names}


def try_extremes(
    spec: ActorSpec, count: int, apply: Callable[[dict[int, Parameters]], None], reset: Callable[[], object]
) -> None:
    """Reset environments with each value that the lessons name, so that one which this host refuses is found at once.

    `count` environments are reset together.
    """
    tried = extremes(spec.lessons, spec.environment.parameters)
    for first in range(0, len(tried), count):
        part = tried[first : first + count]
        apply({index: part[index % len(part)] for index in range(count)})
        reset()
