"""The quick half of `daedalus check`, in a process of its own, before a run starts.

The process ends before the actors start, so that a simulator of which only one can run is free again.
"""

import logging
import os
import threading
from functools import partial
from typing import TYPE_CHECKING, Any

from daedalus.cli.check_process import CheckTimeoutError, EnvironmentCheck, check_in_process
from daedalus.learner.run.default_settings import default_settings
from daedalus.learner.run.settings import preset_names
from daedalus.policy.user_modules import UserModules, modules_of
from daedalus.protocol.spaces import Spaces
from daedalus.protocol.spec import EnvironmentSpec, RunSpec

if TYPE_CHECKING:
    from daedalus.actor.checking.check_report import EnvironmentReport

_logger = logging.getLogger(__name__)

_PLAY_SECONDS, _PLAY_ENV_STEPS = 0.3, 50
_MOST_SECONDS = 20.0  # a simulator may need long to start; the run does not wait for it any longer
_MOST_SECONDS_FOR_SETTINGS = 120.0  # unless its settings depend on the spaces


class EnvironmentProblemError(Exception):
    """Error of an environment that cannot be trained on. The message is one line."""


def checked_spaces(spec: RunSpec, *, fork: bool = False) -> Spaces | None:
    """Check the environment of a run of this machine, log warnings, and return its spaces, or None if it takes long.

    The user has named the modules of the environment. See quick_check. Raises EnvironmentProblemError.
    """
    report = _checked(spec, fork)
    if problem := report.text_problem(spec):
        raise EnvironmentProblemError(problem)
    return report.spaces


def checked_defaults(spec: RunSpec, *, fork: bool = False) -> tuple[Spaces | None, dict[str, Any]]:
    """Check an environment without settings: return its spaces and the default settings for it. See checked_spaces.

    A text that never changes is left out, and logged.
    """
    return _defaults(_checked(spec, fork, for_settings=True), spec)


def _checked(spec: RunSpec, fork: bool, *, for_settings: bool = False) -> "EnvironmentReport":
    from daedalus.actor.checking.check_report import EnvironmentReport, advice, slow_start

    try:
        modules = UserModules(frozenset(modules_of(spec.user_modules)))
        report = quick_check(spec.environment, modules, fork=fork, for_settings=for_settings)
    except CheckTimeoutError as error:
        hint = slow_start(spec)
        _logger.warning("the check of the environment was %s: the run starts without it%s", error, hint)
        return EnvironmentReport()
    if report.problems:
        raise EnvironmentProblemError(with_preset(report.problems[0], spec))
    for warning in report.warnings:
        _logger.warning("%s", warning)
    for text in advice(report, spec, os.cpu_count() or 1):
        _logger.info("%s", text)
    return report


def with_preset(problem: str, spec: RunSpec) -> str:
    """Return a problem, with a hint if the unknown environment has the name of a preset."""
    name = spec.environment.id
    return f"{problem}; {name!r} is a preset, which is named without --env" if name in preset_names() else problem


def transformed_spaces(spec: RunSpec, before: RunSpec, spaces: Spaces | None, *, fork: bool = False) -> Spaces | None:
    """Return the spaces after the transforms of `spec`; `spaces` are those with the transforms of `before`.

    Raises EnvironmentProblemError.
    """
    if spec.environment == before.environment or spaces is None:
        return spaces
    try:
        modules = UserModules(frozenset(modules_of(spec.user_modules)))
        report = quick_check(spec.environment, modules, play=False, fork=fork)
    except CheckTimeoutError:
        return None
    if problem := (*report.problems, report.text_problem(spec))[0]:
        raise EnvironmentProblemError(problem)
    return report.spaces


def expected_spaces(spec: RunSpec, modules: UserModules, stop: threading.Event) -> Spaces | None:
    """Return the spaces of a run's environment, or None where it cannot be made. Only makes the environment.

    Args:
      spec: the run.
      modules: the modules that may be imported.
      stop: ends the attempt early when it is set.
    """
    report = _expected(spec, modules, stop)
    if problem := report.text_problem(spec):
        _logger.info("%s", problem)
        return None
    return report.spaces


def expected_defaults(
    spec: RunSpec, modules: UserModules, stop: threading.Event
) -> tuple[Spaces | None, dict[str, Any]]:
    """Return the spaces of an environment without settings, and the default settings for it. See expected_spaces."""
    return _defaults(_expected(spec, modules, stop, for_settings=True), spec)


def _expected(
    spec: RunSpec, modules: UserModules, stop: threading.Event, *, for_settings: bool = False
) -> "EnvironmentReport":
    from daedalus.actor.checking.check_report import EnvironmentReport

    try:
        report = quick_check(spec.environment, modules, play=False, stop=stop, for_settings=for_settings)
    except CheckTimeoutError as error:
        reason = f"the check of environment {spec.environment.id} was {error}"
    else:
        if report.spaces is not None and not report.problems:
            return report
        reason = report.problems[0]
    _logger.info("the first actor decides the spaces of the run, because they are not known here: %s", reason)
    return EnvironmentReport()


def _defaults(report: "EnvironmentReport", spec: RunSpec) -> tuple[Spaces | None, dict[str, Any]]:
    for name, text in report.constant_texts.items():
        _logger.info("observation component %r is left out (environment.leave_out): it is always %r", name, text)
    if report.spaces is None:
        _logger.warning(
            "the default settings are those for numbers and discrete actions, because the spaces of environment %s are "
            "not known: if it has images or continuous actions, name the settings with --set or in a TOML file",
            spec.environment.id,
        )
    return report.spaces, default_settings(report.spaces, [*spec.environment.leave_out, *report.constant_texts])


def quick_check(
    spec: EnvironmentSpec,
    modules: UserModules,
    *,
    play: bool = True,
    fork: bool = False,
    stop: threading.Event | None = None,
    for_settings: bool = False,
) -> "EnvironmentReport":
    """Make one environment, play it for up to 0.3 s, close it, and return what was found.

    Args:
      spec: the environment and its transforms.
      modules: the modules that may be imported for it.
      play: False only makes it, for its spaces.
      fork: start the process by a fork if it is safe, which takes 0.1 s instead of 0.5 s. For commands, whose process
        has nothing that does not work after a fork.
      stop: ends the check early when it is set.
      for_settings: wait longer for a simulator that starts slowly: the settings of the run depend on its spaces.

    Raises CheckTimeoutError.
    """
    most_seconds = _MOST_SECONDS_FOR_SETTINGS if for_settings else _MOST_SECONDS
    waiting = "the check of environment %s takes long: waiting up to %g s, because its spaces decide the settings"
    return check_in_process(
        EnvironmentCheck(
            spec=spec,
            modules=modules,
            seconds=_PLAY_SECONDS if play else 0.0,
            env_steps=_PLAY_ENV_STEPS,
            most_seconds=most_seconds,
        ),
        fork=fork,
        stop=stop,
        slow_seconds=_MOST_SECONDS,
        on_slow=partial(_logger.info, waiting, spec.id, most_seconds),
    )
