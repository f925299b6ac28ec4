"""The parameters that episodes are played with in a run with lessons. No network, no threads."""

from collections.abc import Callable, Iterable

import numpy as np

from daedalus.protocol.lessons import LessonPlan, LessonRange, Parameters, as_true, extremes
from daedalus.protocol.spec import ActorSpec


class LessonDraws:
    """Draws the parameters of episodes from the newest plan of the learner.

    Attributes:
      plan: from which to draw; None: the true task, until a plan has come.
    """

    def __init__(self, spec: ActorSpec, random: np.random.Generator) -> None:
        """Construct from the run, whose lessons these are, and the source of random numbers."""
        self._true_task, self.names = spec.environment.parameters, sorted(spec.lessons)
        self._random, self.plan = random, LessonPlan(ranges={})

    def draw(self) -> dict[str, int | float]:
        """Return the parameters of an episode."""
        drawn: dict[str, int | float] = dict(self._true_task)
        for name in self.names:
            if ranges := self.plan.ranges.get(name):
                drawn[name] = self._one(self._true_task[name], ranges)
        return drawn

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


class EpisodeLessons:
    """The parameters of E environments' episodes: those that are being played, and those of the episodes that ended."""

    def __init__(
        self, count: int, spec: ActorSpec, draws: LessonDraws, apply: Callable[[dict[int, Parameters]], None]
    ) -> None:
        """Construct for `count` environments; `apply` lets some of them, by index, begin their next episodes so."""
        self.draws, self._apply = draws, apply
        self._playing: list[Parameters] = [dict(spec.environment.parameters) for _ in range(count)]
        self._due = np.ones(count, np.bool_)  # [E] whether the next step or reset begins another episode
        self._finished: list[Parameters] = []

    def begin_due(self) -> None:
        """Draw the parameters of the episodes that begin with the next reset or step. Call it before each."""
        if not np.count_nonzero(self._due):
            return
        drawn: dict[int, Parameters] = {index: self.draws.draw() for index in np.flatnonzero(self._due).tolist()}
        for index, parameters in drawn.items():
            self._playing[index] = parameters
        self._due[:] = False
        self._apply(drawn)

    def end(self, ended: np.ndarray) -> None:
        """Note which episodes ended with a step, [E] bool."""
        self._due = ended
        if np.count_nonzero(ended):
            self._finished += [self._playing[index] for index in np.flatnonzero(ended).tolist()]

    def take_finished(self) -> dict[str, np.ndarray]:
        """Return the parameters with lessons of the episodes that ended since the last call, {name: [K]}."""
        finished, self._finished = self._finished, []
        return lesson_arrays(self.draws.names, finished)


def lesson_arrays(names: Iterable[str], episodes: list[Parameters]) -> dict[str, np.ndarray]:
    """Return what a rollout says of K episodes, {name: [K] float64}; empty without episodes."""
    return {name: np.array([each[name] for each in episodes], np.float64) for name in names if episodes}


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
