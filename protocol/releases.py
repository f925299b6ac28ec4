"""Releases of daedalus-rl: which one this is, what to do where two do not fit, and the settings that earlier ones had.

A process states its release in Join, Welcome and StatusReport, and in the Refusal of another release. The field can be
read in messages of any protocol version (codec.py).
"""

import functools
import importlib.metadata
import re

from pydantic import ValidationError

from daedalus.protocol.texts import bounded_text

_DISTRIBUTION = "daedalus-rl"
_RELEASE = re.compile(r"[A-Za-z][A-Za-z0-9._-]{0,31} [0-9][A-Za-z0-9.+-]{0,31}", re.ASCII)  # a name and a version

# Settings that earlier releases had, by `section.key`, and what replaced each.
REPLACED_SETTINGS = {
    "environment.continuing": "environment.bootstrap_terminations",
    "environment.patience": "environment.no_reward_limit",
    "service.metrics_writers": "the option --log module:Class of `daedalus train` and `daedalus learner`",
    "training.target_rate": "no setting (`sac` has no target critics any more: remove the line)",
}
_MOST_DESCRIBED = 100  # faults of a model; pydantic describes all or none
REPLACED_VALUES = {("environment.backend", "sketch"): "fast"}


def unknown_settings(error: ValidationError) -> str:
    """Return which settings this release does not know, and what replaced each; without any, the kind of error."""
    if error.error_count() > _MOST_DESCRIBED:
        return f"{error.error_count():,} values are not valid"
    paths = [".".join(map(str, each["loc"])) for each in error.errors() if each["type"] == "extra_forbidden"]
    texts = [
        f"{replacement} replaces {path}" if (replacement := REPLACED_SETTINGS.get(path)) else f"unknown setting {path}"
        for path in paths
    ]
    return bounded_text("; ".join(texts) or type(error).__name__)


@functools.cache
def own_release() -> str:
    """Return the name and the version of the software of this process, such as `daedalus-rl 1.2.3`."""
    try:
        version = importlib.metadata.version(_DISTRIBUTION)
    except importlib.metadata.PackageNotFoundError:  # the source code without an installation
        version = "unknown"
    return f"{_DISTRIBUTION} {version}"


def as_release(text: object) -> str:
    """Return what a peer states as its release, or an empty text if it does not have the form of one."""
    return text if isinstance(text, str) and _RELEASE.fullmatch(text) else ""


def remedy(written_by: object) -> str:
    """Return which other release wrote a file that this one cannot use, and which to install; empty if it is this one.

    `written_by` is a release as the file states it, which may be anything.
    """
    theirs, own = as_release(written_by), own_release()
    if not theirs or theirs == own:
        return ""
    version = theirs.partition(" ")[2]
    if _numbers(version) > _numbers(own.partition(" ")[2]):
        return f"{theirs} wrote it, which is newer than this one, {own}: pip install '{_DISTRIBUTION}>={version}'"
    return f"{theirs} wrote it, and this is {own}: use that release for it, pip install '{_DISTRIBUTION}=={version}'"


def _numbers(version: str) -> list[int]:
    found = re.match(r"[0-9]+(?:\.[0-9]+)*", version)
    return [int(part) for part in found[0].split(".")] if found else []


def misfit(theirs: str, their_version: int, own_version: int) -> str:
    """Return which release does not fit which, and which end to upgrade to what.

    Args:
      theirs: release of the other end, as it states it; empty if it is not known.
      their_version: protocol version of its message.
      own_version: protocol version that this release reads.
    """
    own = own_release()
    if not theirs:
        return (
            f"the other end uses protocol version {their_version}, this one {own_version}: "
            "upgrade daedalus-rl at the end with the lower version"
        )
    if theirs == own:
        return (
            f"the other end has another {own} than this one (protocol version {their_version} and {own_version}): "
            "install the same at both ends"
        )
    older, newer = (own, theirs) if their_version > own_version else (theirs, own)
    return f"{own} cannot read messages of {theirs}: upgrade the end that has {older} to {newer}"
