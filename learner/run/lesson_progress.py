"""How far the lessons of a run have come: what actors draw next, from the returns of the episodes that they played."""

import logging
from collections import deque
from collections.abc import Sequence
from itertools import pairwise
from typing import Annotated, Any

import numpy as np
from pydantic import BaseModel, Field

from daedalus.protocol.lessons import MAX_RANGES, LessonPlan, LessonRange, LessonSpec, as_true
from daedalus.protocol.spec import RunSpec
from daedalus.protocol.texts import bounded_text, exact_number, short_number
from daedalus.protocol.uploads import Upload, mean_return

_PARTS = 8  # of a range whose parts are compared, at most
# A part's mean return over about 20 episodes is compared with that over about 100. As in Matiisen et al. (2017),
# "Teacher-Student Curriculum Learning", a fall counts like a rise: what is being forgotten is played more often, too.
_FAST, _SLOW = 1 / 20, 1 / 100
_FIRST_EPISODES = 10  # of each part, before they are compared
_EVERYWHERE = 0.2  # share of the episodes that are drawn uniformly even so

_logger = logging.getLogger(__name__)


class PartState(BaseModel, strict=True):
    """Mean returns of one part of a range."""

    episodes: Annotated[int, Field(ge=0)] = 0
    fast: float = 0.0
    slow: float = 0.0

    def add(self, episode_return: float) -> None:
        """Add an episode."""
        self.episodes += 1
        self.fast += max(_FAST, 1 / self.episodes) * (episode_return - self.fast)
        self.slow += max(_SLOW, 1 / self.episodes) * (episode_return - self.slow)


class LessonState(BaseModel):
    """State of one lesson, as a checkpoint keeps it."""

    settings: dict[str, Any]  # of the lesson, and its true value: another lesson begins anew
    step: Annotated[int, Field(ge=0)] = 0  # of `steps`; their number: the true task
    returns: Annotated[deque[float], Field(max_length=1 << 20)] = deque()  # of the newest episodes of the step
    episodes: Annotated[int, Field(ge=0)] = 0  # of the step
    parts: Annotated[list[PartState], Field(max_length=MAX_RANGES)] = []


class _Lesson:
    """One lesson. Its state changes with each episode."""

    def __init__(self, name: str, run: RunSpec, state: LessonState | None) -> None:
        self.name, self._spec, self.true_value = name, run.lessons[name], run.environment.parameters[name]
        self._episodes = run.training.target_episodes
        settings = {**self._spec.model_dump(mode="json"), "true_value": self.true_value}
        self.state = LessonState(settings=settings)
        if state is not None and state.settings == settings:
            self.state = state
        self._ranges = _parts(self._spec, self.true_value)
        if len(self.state.parts) != len(self._ranges):
            self.state.parts = [PartState() for _ in self._ranges]
        self.played: deque[float] = deque(maxlen=self._episodes)  # of the newest episodes

    def value(self, env_steps: int) -> int | float | None:
        """Return what each episode is played with now, or None if episodes draw it from a range."""
        spec, true_value = self._spec, self.true_value
        if spec.start is not None:
            assert spec.until_env_steps is not None
            share = min(env_steps / spec.until_env_steps, 1.0)
            return true_value if share == 1.0 else as_true(true_value, spec.start + share * (true_value - spec.start))
        if spec.steps is not None:
            step = self.state.step
            return as_true(true_value, spec.steps[step]) if step < len(spec.steps) else true_value
        return None

    def ranges(self, env_steps: int) -> tuple[LessonRange, ...]:
        """Return from which ranges actors draw now."""
        value = self.value(env_steps)
        if value is not None:
            return (LessonRange(low=value, high=value),)
        return tuple(
            LessonRange(low=low, high=high, weight=weight)
            for (low, high), weight in zip(self._ranges, self._weights(), strict=True)
        )

    def _weights(self) -> list[float]:
        """Return the probability of each part of the range."""
        whole = isinstance(self.true_value, int)
        sizes = np.array([high - low + whole for low, high in self._ranges], np.float64)
        uniform = sizes / sizes.sum()
        parts = self.state.parts
        progress = np.array([abs(each.fast - each.slow) for each in parts])
        if min(each.episodes for each in parts) < _FIRST_EPISODES or not progress.sum() > 0.0:
            return uniform.tolist()
        return (_EVERYWHERE * uniform + (1.0 - _EVERYWHERE) * progress / progress.sum()).tolist()

    def add(self, values: Sequence[float], returns: Sequence[float], env_steps: int) -> None:
        """Add episodes: the value that each was played with, and its return."""
        self.played.extend(values)
        for value, episode_return in zip(values, returns, strict=True):
            if self._spec.steps is not None:
                self._add_to_step(value, episode_return, env_steps)
            elif self._spec.where == "progress":
                highs = [high for _, high in self._ranges]
                self.state.parts[min(int(np.searchsorted(highs, value)), len(highs) - 1)].add(episode_return)

    def _add_to_step(self, value: float, episode_return: float, env_steps: int) -> None:
        """Count an episode for the present step, unless it began under an earlier one."""
        steps, state, above = self._spec.steps, self.state, self._spec.above
        if steps is None or above is None or state.step >= len(steps) or value != self.value(0):
            return
        state.returns.append(episode_return)
        state.episodes += 1
        while len(state.returns) > self._episodes:  # also after a resume with a smaller number
            state.returns.popleft()
        # Not after each episode, so that an episode costs the same however many are compared.
        if len(state.returns) < self._episodes or state.episodes % max(self._episodes // 20, 1):
            return
        # The highest and the lowest twentieth count as much as the next: one false return must not end a step.
        aside, ordered = len(state.returns) // 20, np.sort(state.returns)
        mean = mean_return(ordered.clip(ordered[aside], ordered[-1 - aside]))
        if mean < above:
            return
        while state.step < len(steps) and self.value(0) == value:  # equal values in a row are one step
            state.step += 1
        state.returns.clear()
        state.episodes = 0
        _logger.info(
            "lesson %s: %s after %s env_steps; the return with %s was %s",
            self.name,
            self.text(env_steps),
            f"{env_steps:,}",
            exact_number(value),
            short_number(mean),
        )

    def text(self, env_steps: int) -> str:
        """Return what is played now, for a person."""
        spec, value = self._spec, self.value(env_steps)
        if value is not None:
            shown = f"{value:.4g}" if isinstance(value, float) else str(value)
            if spec.steps is not None and self.state.step < len(spec.steps):
                return f"{shown} (step {self.state.step + 1} of {len(spec.steps) + 1})"
            if spec.until_env_steps is not None and env_steps < spec.until_env_steps:
                return f"{shown} (until {spec.until_env_steps:,} env_steps)"
            return f"{shown} (the true task)"
        assert spec.between is not None
        text = f"{exact_number(spec.between[0])} to {exact_number(spec.between[1])}"
        weights = self._weights()
        if max(weights) > 1.5 / len(weights):
            low, high = self._ranges[int(np.argmax(weights))]
            often = f"{low:.4g}" if low == high else f"{low:.4g} to {high:.4g}"
            text += f" (most often {often})"
        return text


def _parts(spec: LessonSpec, true_value: int | float) -> list[tuple[float, float]]:
    """Return the parts of a range whose learning progress is compared, from low to high; one if none is."""
    if spec.between is None:
        return []
    low, high = spec.between
    if spec.where == "everywhere":
        return [(low, high)]
    if isinstance(true_value, int):  # the parts share no value
        size = round(high - low) + 1
        count = min(size, _PARTS)
        firsts = [round(low) + size * part // count for part in range(count + 1)]
        return [(first, after - 1) for first, after in pairwise(firsts)]
    bounds = np.linspace(low, high, _PARTS + 1).tolist()
    return list(pairwise(bounds))


def lessons_violation(upload: Upload, run: RunSpec) -> str:
    """Return why an upload does not acknowledge the lessons of its episodes, or an empty string."""
    given = upload.lessons.keys()
    if (given or len(upload.episode_returns)) and given != run.lessons.keys():
        return (
            f"lessons are of {bounded_text(', '.join(sorted(given)), 100) or 'no parameter'}, and those of the run of "
            f"{', '.join(sorted(run.lessons)) or 'none'}"
        )
    for name, values in upload.lessons.items():
        known = [*run.lessons[name].values, run.environment.parameters[name]]
        low, high = float(min(known)), float(max(known))
        margin = 1e-9 * max(abs(low), abs(high))
        if not ((values >= low - margin) & (values <= high + margin)).all():  # nor nan
            return f"lessons {name!r} has a value that is not from {low:g} to {high:g}"
    return ""


class LessonProgress:
    """The lessons of one run; there may be none. The caller holds the run's lock, except for `plan`."""

    def __init__(self, spec: RunSpec, states: dict[str, LessonState] | None = None) -> None:
        """`states` are those of a checkpoint, by parameter."""
        self._lessons = {name: _Lesson(name, spec, (states or {}).get(name)) for name in sorted(spec.lessons)}

    def add(self, uploads: Sequence[Upload], env_steps: int) -> None:
        """Add the episodes that ended in uploads, in their order. `env_steps` is the number of the run."""
        for upload in uploads:
            for name, values in upload.lessons.items():
                self._lessons[name].add(values.tolist(), upload.episode_returns.tolist(), env_steps)

    def plan(self, env_steps: int) -> LessonPlan | None:
        """Return what a snapshot carries for actors; None without lessons."""
        if not self._lessons:
            return None
        return LessonPlan(ranges={name: lesson.ranges(env_steps) for name, lesson in self._lessons.items()})

    def means(self) -> dict[str, float]:
        """Return the mean value of each parameter over the newest episodes; without those that have no episode yet."""
        return {name: float(np.mean(each.played)) for name, each in self._lessons.items() if each.played}

    def texts(self, env_steps: int) -> dict[str, str]:
        """Return what is played now, by parameter, for a person."""
        return {name: lesson.text(env_steps) for name, lesson in self._lessons.items()}

    def states(self) -> dict[str, Any]:
        """Return what a checkpoint keeps, as plain JSON values."""
        return {name: lesson.state.model_dump(mode="json") for name, lesson in self._lessons.items()}
