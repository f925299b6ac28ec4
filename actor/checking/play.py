"""Plays one environment with random actions and reports what it does. No threads."""

import re
import time
from collections.abc import Iterator
from contextlib import suppress
from typing import Any

import gymnasium
import numpy as np
from gymnasium.vector.utils import batch_space, concatenate, create_empty_array, iterate

from daedalus.actor.checking.random_actions import RandomActions
from daedalus.actor.checking.report import EnvironmentReport
from daedalus.actor.checking.single import make_one
from daedalus.actor.checking.statistics import unsaved_statistics
from daedalus.actor.checking.texts import Texts
from daedalus.actor.checking.vectorized import vectorized_problem
from daedalus.actor.checking.violations import (
    Violation,
    learned_reward_violations,
    reset_violations,
    step_violations,
)
from daedalus.actor.environments.closing import limited_close
from daedalus.actor.environments.environment_errors import EnvironmentSetupError
from daedalus.actor.environments.leaves import without
from daedalus.actor.environments.masks import MASK_KEY, has_choices, mask_of_one
from daedalus.actor.environments.precision import Precision
from daedalus.actor.environments.transforms import Transforms
from daedalus.policy.user_code import first_line, place_of
from daedalus.policy.user_modules import USER_STATE, UserModules
from daedalus.protocol.spaces import ArraySpace
from daedalus.protocol.spec import EnvironmentSpec


class _ProblemError(Exception):
    """Error of an environment that cannot be played on."""


def check_environment(
    spec: EnvironmentSpec, modules: UserModules, *, seconds: float, env_steps: int, seed: int = 0
) -> EnvironmentReport:
    """Make one environment, play it with random actions, and close it; then the same with its vector entry point.

    Where training has arguments of its own, the environment is also made as evaluations play it. Texts of the
    observation that never change are left out, and reported.

    Args:
      spec: the environment and its transforms.
      modules: the modules that may be imported for it.
      seconds: how long to play, unless `env_steps` are done before; 0 only makes the environment.
      env_steps: the most steps.
      seed: of the environment and the actions.
    """
    report = _check_one(spec, modules, seconds, env_steps, seed)
    if report.problems or report.spaces is None or seconds == 0.0:
        return report
    left_out = spec.model_copy(update={"leave_out": (*spec.leave_out, *report.constant_texts)})
    problem = vectorized_problem(left_out, modules, report.spaces, seed) or _evaluated_problem(spec, modules, report)
    return report.model_copy(update={"problems": (problem,)}) if problem else report


def _evaluated_problem(spec: EnvironmentSpec, modules: UserModules, trained: EnvironmentReport) -> str:
    """Return why evaluations cannot play what was trained with `environment.training_kwargs`, or an empty string."""
    if not spec.training_kwargs:
        return ""
    report = _check_one(spec.as_evaluated(), modules, 0.0, 0, 0)
    if report.problems:
        return f"{report.problems[0]} (evaluations play it without environment.training_kwargs)"
    if report.spaces != trained.spaces:
        return (
            f"environment {spec.id}: evaluations, which play it without environment.training_kwargs, have "
            f"{report.spaces}, but training has {trained.spaces}"
        )
    return ""


def _check_one(
    spec: EnvironmentSpec, modules: UserModules, seconds: float, env_steps: int, seed: int
) -> EnvironmentReport:
    try:
        environment, rest = make_one(spec, modules)
    except EnvironmentSetupError as error:
        return EnvironmentReport(problems=(str(error),))
    try:
        mask = _first_mask(environment, seed) if has_choices(environment.action_space, spec) else None
        texts = Texts(environment.observation_space, rest.leave_out)
        texts.watch(environment, seed)
        rest = rest.model_copy(update={"leave_out": (*rest.leave_out, *texts.names)})
        space = without(environment.observation_space, rest.leave_out)
        transforms = Transforms(rest, environment.observation_space, environment.action_space, mask)
        play = _Play(spec, environment, space, transforms, RandomActions(transforms.spaces.actions, seed), texts)
        if seconds > 0.0:
            play.run(seconds, env_steps, seed)
        return play.report()
    except EnvironmentSetupError as error:
        return EnvironmentReport(problems=(str(error),))
    finally:
        with suppress(Exception, SystemExit), limited_close():  # of the user's code
            environment.close()


def _first_mask(environment: gymnasium.Env, seed: int) -> Any:
    """Return the mask of the first action with a first axis of 1, or None if the environment has no masks."""
    with suppress(Exception, SystemExit):  # of the user's code; playing reports it
        mask = environment.reset(seed=seed)[1].get(MASK_KEY)
        return None if mask is None else mask_of_one(mask)
    return None


class _Play:
    """One environment in play, and what was found so far."""

    def __init__(
        self,
        spec: EnvironmentSpec,
        environment: gymnasium.Env,
        observation_space: gymnasium.Space,
        transforms: Transforms,
        random_actions: RandomActions,
        texts: Texts,
    ) -> None:
        self._name, self._spec, self._environment, self._texts = spec.id, spec, environment, texts
        self._observation_space = observation_space  # without what is left out
        self._transforms, self._random_actions = transforms, random_actions
        self._precision = Precision(observation_space)
        self._problems: list[str] = []
        self._masks: dict[str, np.ndarray] = {}  # of the next action
        self._warnings = {text: text for text in unsaved_statistics(environment)}  # the first of each kind
        self._pixel_maxima = {  # the largest value seen in each image
            name: 0
            for name, each in transforms.spaces.observations.items()
            if isinstance(each, ArraySpace) and each.is_image
        }
        self._env_steps, self._resets = 0, 0
        self._step_seconds, self._busy_seconds, self._reset_seconds = 0.0, 0.0, 0.0
        self._lengths: list[int] = []
        self._returns: list[float] = []

    def run(self, seconds: float, env_steps: int, seed: int) -> None:
        """Play until the time or the steps are used up, or a problem is found."""
        until = time.monotonic() + seconds
        try:
            self._reset(seed)
            length, episode_return = 0, 0.0
            while not self._env_steps or (self._env_steps < env_steps and time.monotonic() < until):
                reward, over = self._step()
                length, episode_return = length + 1, episode_return + reward
                if over:
                    self._lengths.append(length)
                    self._returns.append(episode_return)
                    self._reset(None)
                    length, episode_return = 0, 0.0
        except _ProblemError as error:
            self._problems.append(str(error))

    def report(self) -> EnvironmentReport:
        """Return what was found."""
        warnings = [*self._warnings.values(), *self._precision.warnings.values()]
        problems = [*self._problems, *([self._texts.problem] if self._texts.problem else [])]
        return EnvironmentReport(
            spaces=self._transforms.spaces,
            constant_texts=self._texts.constant,
            problems=tuple(f"environment {self._name}: {problem}" for problem in problems),
            warnings=tuple(f"environment {self._name}: {warning}" for warning in warnings),
            env_steps=self._env_steps,
            step_seconds=self._step_seconds / max(self._env_steps, 1),
            busy_share=min(self._busy_seconds / max(self._step_seconds, 1e-9), 1.0),
            reset_seconds=self._reset_seconds / max(self._resets, 1),
            time_limit=getattr(self._environment.spec, "max_episode_steps", None),
            pixel_maxima=self._pixel_maxima if self._env_steps else {},
            lengths=tuple(self._lengths),
            returns=tuple(self._returns),
        )

    def _reset(self, seed: int | None) -> None:
        began = time.monotonic()
        result = self._call("reset", seed=seed)
        self._reset_seconds += time.monotonic() - began
        self._resets += 1
        self._add(reset_violations(self._observation_space, result))
        if self._resets == 1:
            self._batch("observation", self._environment.observation_space, result[0])
        self._observe(result[0], result[1], over=False, starts=True)

    def _step(self) -> tuple[float, bool]:
        """Take one random step, and return its reward and whether the episode is over."""
        action = self._transforms.env_action(self._random_actions.choose(self._masks))
        if not self._env_steps:
            self._batch("action", self._environment.action_space, action)
        began, busy = time.monotonic(), time.process_time()
        result = self._call("step", action)
        self._busy_seconds += time.process_time() - busy
        self._step_seconds += time.monotonic() - began
        self._env_steps += 1
        self._add(step_violations(self._observation_space, result))
        observation, reward, terminated, truncated, info = result
        self._add(learned_reward_violations(float(reward), self._spec))
        self._precision.add_reward(reward)
        over = bool(terminated or truncated)
        self._observe(observation, info, over=over)
        return float(reward), over

    def _batch(self, kind: str, space: gymnasium.Space, value: Any) -> None:
        """Raise _ProblemError if gymnasium cannot make a batch of values of a space, or take it apart, as actors do."""
        try:
            batch = concatenate(space, [value, value], create_empty_array(space, n=2))
            for _ in iterate(batch_space(space, 2), batch):
                pass
        except Exception as error:  # broad: a value that does not fit, or a space of a class of its own
            raise _ProblemError(
                f"gymnasium cannot make a batch of the {kind}s, as actors do ({first_line(error)}): let each part of "
                f"{kind}_space have the shape and the dtype of its values"
            ) from None

    def _observe(self, observation: Any, info: dict[str, Any], *, over: bool, starts: bool = False) -> None:
        """Take the masks of the next action. Raise _ProblemError if the run could not use the observation or them."""
        self._texts.add(observation)
        try:
            observed = self._transforms.observe_one(observation, info.get(MASK_KEY), needed=not over)
        except ValueError as error:
            raise _ProblemError(str(error)) from None
        self._precision.add(observation, starts=starts)
        self._masks = observed.masks
        for name, largest in self._pixel_maxima.items():
            self._pixel_maxima[name] = max(largest, int(observed.frames[name].max()))

    def _call(self, method: str, *arguments: Any, **keywords: Any) -> Any:
        try:
            with USER_STATE:
                return getattr(self._environment, method)(*arguments, **keywords)
        except EnvironmentSetupError:  # of a vector environment, or of the transforms
            raise
        except (Exception, SystemExit) as error:  # of the user's code
            wrong = self._structure_of(method, arguments, keywords) if isinstance(error, TypeError | ValueError) else ""
            raise _ProblemError(wrong or f"{method} raises {first_line(error)}{place_of(error)}") from None

    def _structure_of(self, method: str, arguments: tuple[Any, ...], keywords: dict[str, Any]) -> str:
        """Return the problem if a wrapper failed because the environment returns the wrong number of values."""
        unwrapped = self._environment.unwrapped
        violations = reset_violations if method == "reset" else step_violations
        with suppress(Exception, SystemExit):
            result = getattr(unwrapped, method)(*arguments, **keywords)
            found = next(violations(unwrapped.observation_space, result), ("", ""))
            return found[1] if "a tuple" in found[1] else ""
        return ""

    def _add(self, violations: Iterator[Violation]) -> None:
        """Record warnings. Raise _ProblemError for the first problem."""
        for kind, text in violations:
            when = f"after {self._env_steps:,} env_steps" if self._env_steps else "at first"
            if kind == "problem":
                raise _ProblemError(f"{text} ({when})")
            without_numbers = re.sub(r"-?\d[\d.e+-]*", "", text)
            self._warnings.setdefault(without_numbers, f"{text} ({when})")
