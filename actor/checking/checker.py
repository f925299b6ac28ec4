"""Gymnasium's own environment checker."""

import re
import warnings

from gymnasium.utils.env_checker import check_env

from daedalus.actor.checking.single import make_one
from daedalus.actor.environments.environment_errors import EnvironmentSetupError, first_line
from daedalus.policy.user_modules import UserModules
from daedalus.protocol.spec import EnvironmentSpec

_COLOURS = re.compile(r"\x1b\[[0-9;]*m|^WARN: ")


def gymnasium_notes(spec: EnvironmentSpec, modules: UserModules) -> tuple[str, ...]:
    """Return what gymnasium's checker says about an environment: its advice, then the check that failed, if one did.

    It also checks what training does not need, such as equal episodes for equal seeds.
    """
    try:
        environment, _ = make_one(spec, modules)
    except EnvironmentSetupError:
        return ()  # reported before
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        try:
            check_env(environment.unwrapped, skip_render_check=True)
            failed = ()
        except Exception as error:  # of its assertions, or of the user's code
            failed = (f"gymnasium's checker: {first_line(error)}",)
        finally:
            environment.close()
    said = dict.fromkeys(_plain(str(each.message)) for each in caught)
    return (*(f"gymnasium's checker: {text}" for text in said), *failed)


def _plain(text: str) -> str:
    return " ".join(_COLOURS.sub("", _COLOURS.sub("", text)).split())
