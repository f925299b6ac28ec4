"""Groups of runs: runs with equal settings apart from the seed, named by the settings that tell the groups apart.

Pure functions.
"""

import itertools
import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from daedalus.cli.comparing.recorded_run import ENVIRONMENT, SEED, RecordedRun
from daedalus.learner.run.run_files import RunDataError
from daedalus.protocol.texts import exact_number

_SERVICE = "service."  # settings of how the learner runs, not of what it learns
_FIRST = ("training.algorithm", "collection.upload", "collection.rollout_length")  # the names that say most
_MOST_NAMED = 3  # settings in the name of a group, if they are enough


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Group:
    """Runs that differ in their seed only, or that the user put together."""

    name: str
    runs: Sequence[RecordedRun]


def check_comparable(runs: Sequence[RecordedRun]) -> None:
    """Check that runs play the same environment. Raises RunDataError."""
    first: dict[str, Path] = {}
    for run in runs:
        if ENVIRONMENT in run.settings:
            first.setdefault(run.settings[ENVIRONMENT], run.directory)
    if len(first) > 1:
        played = " and ".join(f"{environment} ({directory})" for environment, directory in list(first.items())[:2])
        raise RunDataError(
            f"the runs play different environments, whose returns cannot be compared: {played}; "
            "name the runs of one environment"
        )


def by_settings(runs: Sequence[RecordedRun], keys: Sequence[str] = ()) -> list[Group]:
    """Return the runs as groups of equal settings, sorted by the settings that differ.

    Args:
      runs: the runs; one without settings is a group of its own.
      keys: settings that name the groups (default: the fewest that tell them apart).
    """
    parts: dict[str, list[RecordedRun]] = {}
    for run in runs:
        parts.setdefault(_identity(run, keys), []).append(run)
    groups = list(parts.values())
    chosen = list(keys) or _telling(groups)
    if chosen:
        groups.sort(key=lambda group: [_sortable(group[0].setting(key)) for key in chosen])
    return _named(groups, chosen)


def by_user(parts: Sequence[Sequence[RecordedRun]]) -> list[Group]:
    """Return groups that a user put together, in their order, named by the settings that tell them apart, if any do."""
    return _named(parts, _telling(parts))


def _identity(run: RecordedRun, keys: Sequence[str] = ()) -> str:
    if not run.settings:
        return str(run.directory)
    relevant = {key: value for key, value in run.settings.items() if key in keys or _is_relevant(key)}
    return json.dumps(relevant, sort_keys=True)


def _is_relevant(key: str) -> bool:
    """Return whether a setting tells something about the result of a run."""
    return key != SEED and not key.startswith(_SERVICE)


def _telling(groups: Sequence[Sequence[RecordedRun]]) -> list[str]:
    """Return the fewest settings that are equal within each group and that tell all groups apart; empty if none do."""
    if len(groups) < 2 or not all(run.settings for group in groups for run in group):
        return []
    known = sorted({key for group in groups for run in group for key in run.settings if _is_relevant(key)})
    constant = [key for key in known if all(len({_text(run, key) for run in group}) == 1 for group in groups)]
    differing = [key for key in constant if len({_text(group[0], key) for group in groups}) > 1]
    differing.sort(key=lambda key: (_FIRST.index(key) if key in _FIRST else len(_FIRST), key))
    for count in range(1, _MOST_NAMED + 1):
        for keys in itertools.combinations(differing, count):
            if len({tuple(_text(group[0], key) for key in keys) for group in groups}) == len(groups):
                return list(keys)
    tell = len({tuple(_text(group[0], key) for key in differing) for group in groups}) == len(groups)
    return differing if tell else []


def _named(groups: Sequence[Sequence[RecordedRun]], keys: Sequence[str]) -> list[Group]:
    names = [", ".join(f"{short(key, keys)}={_text(group[0], key)}" for key in keys) for group in groups]
    return [Group(name=name or _own_name(group), runs=group) for name, group in zip(names, groups, strict=True)]


def short(key: str, keys: Sequence[str]) -> str:
    """Return the name of a setting without its section, unless another of `keys` has the same name."""
    name = key.rpartition(".")[2]
    return name if sum(other.rpartition(".")[2] == name for other in keys) == 1 else key


def _own_name(group: Sequence[RecordedRun]) -> str:
    """Return the name of a group that no settings tell apart: that of its run, or what its runs have in common."""
    settings = group[0].settings
    if len(group) > 1 and settings and len({_identity(run) for run in group}) == 1:
        return f"{settings.get(ENVIRONMENT)}, {settings.get('training.algorithm')}"
    if len(group) > 1:
        return f"{group[0].directory.resolve().name} and {len(group) - 1} more"
    return group[0].directory.resolve().name


def _text(run: RecordedRun, key: str) -> str:
    return text(run.setting(key))


def text(value: Any) -> str:
    """Return a value of a setting in few characters."""
    if value is None:
        return "unset"
    if isinstance(value, float):
        return exact_number(value)
    return value if isinstance(value, str) else json.dumps(value, separators=(",", ":"))


def _sortable(value: Any) -> tuple[int, float, str]:
    if isinstance(value, int | float):
        return 0, float(value), ""
    return 1, 0.0, text(value)
