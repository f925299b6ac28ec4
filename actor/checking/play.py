"""Plays one environment with random actions and reports what it does. No threads."""

import operator
import re
import time
from collections.abc import Iterator, Sequence
from contextlib import suppress
from typing import Any

import gymnasium
import numpy as np
from gymnasium.envs.registration import load_env_creator
from gymnasium.vector.utils import batch_space, concatenate, create_empty_array, iterate
from gymnasium.wrappers import NormalizeObservation, NormalizeReward

from daedalus.actor.checking.check_report import EnvironmentReport
from daedalus.actor.checking.checker import (
    STEPS_FOR_MASKS,
    Texts,
    mask_warning,
    minigrid_codes,
    seed_warnings,
    square_maps,
)
from daedalus.actor.checking.game_play import check_game
from daedalus.actor.checking.violations import (
    Violation,
    byte_maxima,
    learned_reward_violations,
    observation_violations,
    reset_violations,
    step_violations,
)
from daedalus.actor.environments import atari
from daedalus.actor.environments.bots import RandomActions
from daedalus.actor.environments.components import batch_of_one, only_of_batch, without
from daedalus.actor.environments.environment_errors import EnvironmentSetupError
from daedalus.actor.environments.gymnasium_backend import make_single, registration, uses_vector_entry_point
from daedalus.actor.environments.gymnasium_environments import limited_close
from daedalus.actor.environments.info import MASK_KEY, has_choices, mask_of_one, only_of_masks, unreported
from daedalus.actor.environments.make import make_bare
from daedalus.actor.environments.parameters import wrapper_of
from daedalus.actor.environments.precision import Precision
from daedalus.actor.environments.transforms import TransformedEnvironment, Transforms
from daedalus.actor.environments.vector_environments import BackendEnvironments, Observed
from daedalus.policy.user_code import first_line, place_of, print_traceback
from daedalus.policy.user_modules import USER_STATE, UserModuleError, UserModules
from daedalus.protocol.lessons import Parameters
from daedalus.protocol.spaces import Spaces, StillObservations, unfit_number
from daedalus.protocol.spec import EnvironmentSpec


class OneOfVector(gymnasium.Env):
    """The only environment of a vector: its steps after the end of an episode are resets here."""

    def __init__(self, environments: BackendEnvironments) -> None:
        self._environments = environments
        self.observation_space, self.action_space = environments.observation_space, environments.action_space
        self._started = False

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Begin the next episode; only the first one has a seed."""
        if self._started:
            observations = self._environments.step(self._batched(self.action_space.sample()))[0]
        else:
            observations, self._started = self._environments.reset(seed or 0), True
        return only_of_batch(self.observation_space, observations), self._info()

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """See gymnasium.Env."""
        observations, rewards, terminated, truncated = self._environments.step(self._batched(action))
        observation = only_of_batch(self.observation_space, observations)
        return observation, float(rewards[0]), bool(terminated[0]), bool(truncated[0]), self._info()

    def _batched(self, action: Any) -> Any:
        return batch_of_one(self.action_space, action, "the action")

    def _info(self) -> dict[str, Any]:
        mask = self._environments.action_mask
        return {} if mask is None else {MASK_KEY: only_of_masks(mask)}

    def close(self) -> None:
        """See gymnasium.Env."""
        self._environments.close()


def make_one(spec: EnvironmentSpec, modules: UserModules) -> tuple[gymnasium.Env, EnvironmentSpec]:
    """Return one environment in this process, and the specification without what the backend does itself.

    Raises EnvironmentSetupError.
    """
    try:
        modules.check(spec.user_modules)
    except UserModuleError as error:
        raise EnvironmentSetupError(str(error)) from None
    single = make_single(spec, modules) if spec.backend in ("gymnasium", "fast") else None
    if single is not None:
        _check_spaces(single, spec.id)
        return single, spec
    environments, rest = make_bare(spec.model_copy(update={"processes": False}), 1, modules)
    return OneOfVector(environments), rest


def _check_spaces(environment: gymnasium.Env, name: str) -> None:
    """Close an environment whose spaces cannot be read, and raise EnvironmentSetupError."""
    for attribute in ("observation_space", "action_space"):
        try:
            getattr(environment, attribute)
        except (Exception, SystemExit) as error:  # of the user's code
            with suppress(Exception, SystemExit):
                environment.close()
            raise EnvironmentSetupError(
                f"environment {name} has no {attribute} ({first_line(error)}): set it in the constructor"
            ) from None


_COUNT, _STEPS, _SECONDS = 2, 50, 1.0  # few: one environment was played before
_SLOW_START = 1.0  # seconds to make an environment


def vectorized_problem(spec: EnvironmentSpec, modules: UserModules, spaces: Spaces, seed: int) -> str:
    """Return what is wrong with the vector entry point, or an empty string, also if training does not use one.

    Args:
      spec: the environment and its transforms.
      modules: the modules that may be imported for it.
      spaces: of one environment that was made without the vector entry point.
      seed: of the environments and the actions.
    """
    try:
        if not uses_vector_entry_point(spec, modules):
            return ""
        bare, rest = make_bare(spec, _COUNT, modules)
        try:
            if problem := _observations_problem(bare, spec, seed):
                return f"environment {spec.id}: {problem} (training uses its vector entry point)"
            environments = TransformedEnvironment(bare, rest)
            if environments.spaces != spaces:
                return (
                    f"environment {spec.id}: its vector entry point has {environments.spaces}, "
                    f"but its entry point has {spaces}"
                )
            random, until = RandomActions(spaces.actions, seed), time.monotonic() + _SECONDS
            observed = environments.reset(seed)
            for _ in range(_STEPS):
                observed, rewards, *_ = environments.step(random.choose_each(observed.masks, _COUNT))
                if problem := _numbers_problem(observed, rewards):
                    return f"environment {spec.id}: step returns {problem} (training uses its vector entry point)"
                if time.monotonic() > until:
                    break
        finally:
            bare.close()
    except EnvironmentSetupError as error:
        return f"{error} (training uses its vector entry point)"
    return ""


def _observations_problem(environments: BackendEnvironments, spec: EnvironmentSpec, seed: int) -> str:
    """Return what makes the first observations differ from their space, or an empty string."""
    space = without(environments.observation_space, spec.leave_out)
    observations = environments.reset(seed)
    try:
        rows = list(iterate(batch_space(environments.observation_space, _COUNT), observations))
    except Exception as error:  # broad: they may be anything
        return f"reset returns observations that are no batch of observation_space ({first_line(error)})"
    if len(rows) != _COUNT:
        return f"reset returns {len(rows)} observations for {_COUNT} environments"
    found = (violation for row in rows for violation in observation_violations(space, row, "reset"))
    return next((text for kind, text in found if kind == "problem"), "")


def _numbers_problem(observed: Observed, rewards: np.ndarray) -> str:
    """Return what the learner would refuse, or an empty string."""
    for name, frames in observed.frames.items():
        if unfit := unfit_number(frames):
            return f"an observation whose component {name!r} {unfit}"
    faulty = ~np.isfinite(rewards)
    return f"the reward {rewards[faulty][0]}: it must be finite" if faulty.any() else ""


def unsaved_statistics(environment: gymnasium.Env) -> tuple[str, ...]:
    """Return a warning for each wrapper of an environment that normalises by statistics of its own."""
    warnings: list[str] = []
    while isinstance(environment, gymnasium.Wrapper):
        if isinstance(environment, NormalizeObservation | NormalizeReward) and environment.update_running_mean:
            name = type(environment).__name__
            setting = "policy.normalize_observations"
            if isinstance(environment, NormalizeReward):
                setting = "training.normalize_rewards"
            warnings.append(
                f"wrapper {name} has statistics of its own in each environment, which are not saved: evaluations begin "
                f"without them; use --set {setting}=true in its place"
            )
        environment = environment.env
    return tuple(warnings)


class _ProblemError(Exception):
    """Error of an environment that cannot be played on."""


def check_environment(
    spec: EnvironmentSpec,
    modules: UserModules,
    *,
    seconds: float,
    env_steps: int,
    seed: int = 0,
    bots: Sequence[str] = (),
    lessons: Sequence[Parameters] = (),
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
      bots: opponents in a game that are code; each plays a match.
      lessons: parameters of episodes, as `extremes` returns them; an episode begins with each, for about `seconds`.
    """
    if spec.is_game:
        return check_game(spec, modules, seconds=seconds, env_steps=env_steps, seed=seed, bots=bots)
    _import_first(spec, modules)
    began = time.monotonic()
    report = _check_one(spec, modules, seconds, env_steps, seed, lessons)
    is_slow = time.monotonic() - began > 2.0 * seconds + _SLOW_START  # to make a second one could take as long
    if report.problems or report.spaces is None or seconds == 0.0:
        return report
    left_out = spec.model_copy(update={"leave_out": (*spec.leave_out, *report.constant_texts)})
    problem = vectorized_problem(left_out, modules, report.spaces, seed) or _evaluated_problem(spec, modules, report)
    if problem:
        return report.model_copy(update={"problems": (problem,)})
    if spec.backend == "gymnasium" and not is_slow:
        more = seed_warnings(left_out, modules, seconds / 3)
        report = report.model_copy(update={"warnings": (*report.warnings, *more)})
    return report.model_copy(update={"vectorized": uses_vector_entry_point(spec, modules)})


def _import_first(spec: EnvironmentSpec, modules: UserModules) -> None:
    """Import what makes the environment, so that the time to make it is known. Making it reports errors."""
    if spec.backend == "gymnasium":
        with suppress(Exception, SystemExit):  # of the user's code
            modules.check(spec.user_modules)
            entry_point = registration(spec.id, modules).entry_point
            if isinstance(entry_point, str):
                load_env_creator(entry_point)


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
    spec: EnvironmentSpec,
    modules: UserModules,
    seconds: float,
    env_steps: int,
    seed: int,
    lessons: Sequence[Parameters] = (),
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
        altered = rest.grey or rest.resize is not None  # as pixels are
        codes = {} if altered else minigrid_codes(environment, space, seed)
        play = _Play(spec, environment, space, transforms, RandomActions(transforms.spaces.actions, seed), texts)
        if seconds > 0.0:
            play.run(seconds, env_steps, seed)
        report = play.report()
        if not report.problems:
            _begin_with(environment, lessons, seed, time.monotonic() + seconds)
        for name, maxima in report.byte_maxima.items():
            if name in codes and not all(map(operator.lt, maxima, codes[name])):
                del codes[name]  # a wrapper has written other numbers into some of them
        return report.model_copy(update={"codes": codes, "maps": () if altered else square_maps(space)})
    except EnvironmentSetupError as error:
        return EnvironmentReport(problems=(str(error),))
    finally:
        with suppress(Exception, SystemExit), limited_close():  # of the user's code
            environment.close()


def _begin_with(environment: gymnasium.Env, lessons: Sequence[Parameters], seed: int, until: float) -> None:
    """Begin an episode with each of some parameters. Raises EnvironmentSetupError for those that are refused."""
    for parameters in lessons[1:]:  # the first are those of the true task
        if time.monotonic() > until:  # actors try the others
            return
        wrapper_of(environment).next_parameters = parameters
        environment.reset(seed=seed)


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
        self._still, self._newest = StillObservations(), dict[str, np.ndarray]()  # the newest observation
        self._problems: list[str] = []
        self._masks: dict[str, np.ndarray] = {}  # of the next action
        found = (*unsaved_statistics(environment), atari.repeated_twice(environment, spec.action_repeat))
        self._warnings = {text: text for text in found if text}  # the first of each kind
        self._byte_maxima = byte_maxima(transforms.spaces)
        self._env_steps, self._resets = 0, 0
        self._step_seconds, self._busy_seconds, self._reset_seconds = 0.0, 0.0, 0.0
        self._lengths: list[int] = []
        self._truncations = 0
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
        still = self._still.text(len(self._lengths))
        warnings = [*self._warnings.values(), *self._precision.warnings.values(), *filter(None, [still])]
        problems = [*self._problems, *([self._texts.problem] if self._texts.problem else [])]
        return EnvironmentReport(
            spaces=self._transforms.spaces,
            first_choices=self._transforms.first_choices,
            constant_texts=self._texts.constant,
            problems=tuple(f"environment {self._name}: {problem}" for problem in problems),
            warnings=tuple(f"environment {self._name}: {warning}" for warning in warnings),
            env_steps=self._env_steps,
            step_seconds=self._step_seconds / max(self._env_steps - 1, 1),
            busy_share=min(self._busy_seconds / max(self._step_seconds, 1e-9), 1.0),
            reset_seconds=self._reset_seconds / max(self._resets, 1),
            time_limit=getattr(self._environment.spec, "max_episode_steps", None),
            byte_maxima={name: tuple(map(int, each)) for name, each in self._byte_maxima.items() if self._env_steps},
            lengths=tuple(self._lengths),
            returns=tuple(self._returns),
            truncations=self._truncations,
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
        if self._env_steps == 1:
            self._step_seconds = self._busy_seconds = 0.0  # the first step may have compiled something
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
        self._truncations += bool(truncated)
        if over and (text := unreported(info)):
            self._warnings.setdefault("a number", text)
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
        if self._env_steps < STEPS_FOR_MASKS and (text := mask_warning(self._transforms.spaces, info, observed.frames)):
            self._warnings.setdefault("a mask", f"{text} (--wrap MODULE:FUNCTION)")
        before, self._newest = self._newest, observed.frames
        rows = {name: np.stack([frames, observed.frames[name]])[:, None] for name, frames in before.items()}
        self._still.add(rows, np.array([[bool(before) and not (starts or over)]]))
        for name, largest in self._byte_maxima.items():
            np.maximum(largest, observed.frames[name].reshape(-1, len(largest)).max(0), out=largest)

    def _call(self, method: str, *arguments: Any, **keywords: Any) -> Any:
        try:
            with USER_STATE:
                return getattr(self._environment, method)(*arguments, **keywords)
        except EnvironmentSetupError:  # of a vector environment, or of the transforms
            raise
        except (Exception, SystemExit) as error:  # of the user's code
            wrong = self._structure_of(method, arguments, keywords) if isinstance(error, TypeError | ValueError) else ""
            if not wrong:
                print_traceback(error)
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
