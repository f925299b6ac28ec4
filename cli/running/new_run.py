"""The settings and spaces of a new run, some of which its environment decides."""

from collections.abc import Callable
from typing import Any

from daedalus.cli.own_algorithm import with_record
from daedalus.cli.quick_check import checked_defaults, checked_spaces, transformed_spaces
from daedalus.learner.run.settings import SettingsError, unmeasured_target
from daedalus.policy.user_code import Surroundings
from daedalus.policy.user_modules import UserModules, modules_of
from daedalus.protocol.spaces import Spaces
from daedalus.protocol.spec import RunSpec


def prepare(
    resolve: Callable[[dict[str, Any] | None], RunSpec], *, env: str | None, fork: bool = False
) -> tuple[RunSpec, Spaces | None]:
    """Return the specification of a new run, and its spaces or None where the check of the environment takes long.

    Args:
      resolve: returns the specification; called with the settings that `env` begins with, or None before they are
        known. See settings_arguments.resolve.
      env: the environment, if the user named no preset.
      fork: see quick_check.

    Raises SettingsError, or EnvironmentProblemError.
    """
    with Surroundings():  # which an algorithm of the user may change when it is imported
        return _prepared(resolve, env, fork=fork)


def _prepared(
    resolve: Callable[[dict[str, Any] | None], RunSpec], env: str | None, *, fork: bool
) -> tuple[RunSpec, Spaces | None]:
    spec = resolve(None)
    if env is None:
        spaces = checked_spaces(spec, fork=fork)
    else:
        spaces, defaults = checked_defaults(spec, fork=fork)
        chosen = resolve(defaults)
        spaces, spec = transformed_spaces(chosen, spec, spaces, fork=fork), chosen
    if problem := unmeasured_target(spec):
        raise SettingsError(problem)
    return with_record(spec, UserModules(frozenset(modules_of(spec.user_modules)))), spaces
