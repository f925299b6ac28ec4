"""Groups of runs: runs with equal settings apart from the seed, named by the settings that tell the groups apart."""

import itertools
import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Generic, TypeVar

from daedalus.analysis.recorded_run import BEGUN_WITH, ENVIRONMENT, SEED, RecordedRun, read_run
from daedalus.analysis.run_selection import find_runs
from daedalus.learner.run.run_files import RunDataError
from daedalus.learner.run.settings import value_text

_SERVICE = "service."  # settings of how the learner runs, not of what it learns
_FIRST = ("training.algorithm", "collection.upload", "collection.rollout_length")  # the names that say most
_MOST_TELLING = 3  # settings that are looked for, of the fewest that tell groups apart
_MOST_NAMED = 4  # settings in the name of a group, if they are enough
_LONGEST_VALUE = 24  # characters of a value in a name, if different values stay different


Run = TypeVar("Run", bound=RecordedRun)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Group(Generic[Run]):
    """Runs that differ in their seed only, or that the user put together."""

    name: str
    runs: Sequence[Run]
    unnamed: Sequence[str] = ()  # settings in which the groups differ, and that are not in the name

    @property
    def label(self) -> str:
        """The name, and how many runs there are if there are several."""
        return f"{self.name} ({len(self.runs)} runs)" if len(self.runs) > 1 else self.name


def environment_of(groups: Sequence[Group]) -> str:
    """Return the environment that the runs of some groups play; empty if it is unknown."""
    runs = (run for group in groups for run in group.runs)
    return next((run.settings[ENVIRONMENT] for run in runs if ENVIRONMENT in run.settings), "")


def _by_environment(parts: Sequence[Sequence[Run]]) -> list[list[list[Run]]]:
    """Return parts with the runs of one environment each, by environment: returns of others cannot be compared.

    A run whose environment is unknown is with the others if they play one only.
    """
    played = {run.settings.get(ENVIRONMENT) for part in parts for run in part}
    if len(played - {None}) < 2:
        return [[list(part) for part in parts]]
    ordered = sorted(played, key=lambda environment: (environment is None, environment or ""))
    return [
        [[run for run in part if run.settings.get(ENVIRONMENT) == environment] for part in parts]
        for environment in ordered
    ]


def by_settings(runs: Sequence[Run], keys: Sequence[str] = ()) -> list[Group[Run]]:
    """Return the runs as groups of equal settings, sorted by the settings that differ.

    Args:
      runs: the runs; one without settings is a group of its own.
      keys: settings that name the groups (default: those in which the groups differ).
    """
    parts: dict[str, list[Run]] = {}
    for run in runs:
        parts.setdefault(_identity(run, keys), []).append(run)
    groups = list(parts.values())
    differing = _differing(groups)
    chosen = list(keys) or differing
    if chosen:
        groups.sort(key=lambda group: [_sortable(group[0].setting(key)) for key in chosen])
    return _named(groups, differing, keys)


def by_user(parts: Sequence[Sequence[Run]]) -> list[Group[Run]]:
    """Return groups that a user put together, in their order, named by the settings that differ, if any do."""
    return _named(parts, _differing(parts))


def _identity(run: RecordedRun, keys: Sequence[str] = ()) -> str:
    if not run.settings:
        return str(run.directory)
    relevant = {key: value for key, value in run.settings.items() if key in keys or _is_relevant(key)}
    return json.dumps({**relevant, BEGUN_WITH: run.begun_with}, sort_keys=True)


def _is_relevant(key: str) -> bool:
    """Return whether a setting tells something about the result of a run."""
    return key != SEED and not key.startswith(_SERVICE)


def _differing(groups: Sequence[Sequence[RecordedRun]]) -> list[str]:
    """Return the settings in which groups differ; first the fewest that tell all groups apart, if a few do."""
    runs = [run for group in groups for run in group]
    if len(groups) < 2 or not all(run.settings for run in runs):
        return []
    known = {part for run in runs for key in run.settings if _is_relevant(key) for part in _parts(key, runs)}
    differing = [key for key in (*known, BEGUN_WITH) if len({_text(group, key) for group in groups}) > 1]
    differing.sort(key=lambda key: (_FIRST.index(key) if key in _FIRST else len(_FIRST), key))
    for count in range(1, _MOST_TELLING + 1):
        for keys in itertools.combinations(differing, count):
            if len({tuple(_text(group, key) for key in keys) for group in groups}) == len(groups):
                return [*keys, *(key for key in differing if key not in keys)]
    return differing


def _parts(key: str, runs: Sequence[RecordedRun]) -> list[str]:
    """Return a setting, or its parts if it is a table in all runs."""
    values = [run.settings.get(key) or {} for run in runs]
    names = {name for value in values if isinstance(value, dict) for name in value}
    if not all(isinstance(value, dict) for value in values) or any("." in name for name in names):
        return [key]
    return [f"{key}.{name}" for name in names]


def _named(groups: Sequence[Sequence[Run]], differing: Sequence[str], chosen: Sequence[str] = ()) -> list[Group[Run]]:
    """Return groups with names: of the chosen settings, or else of the first of those that differ."""
    names, keys = [""] * len(groups), list[str]()
    for tried in [chosen] if chosen else (differing[:_MOST_NAMED], differing):
        columns = [_shortened([_text(group, key) for group in groups]) for key in tried]
        rows = [
            ", ".join(f"{short(key, tried)}={value}" for key, value in zip(tried, row, strict=True))
            for row in zip(*columns, strict=True)
        ]
        if chosen or len(set(rows)) == len(groups):
            names, keys = rows, list(tried)
            break
    unnamed = [key for key in differing if key not in keys]
    more = f", +{len(unnamed)} more" if unnamed and not chosen else ""
    return [
        Group(name=f"{name}{more}" if name else _own_name(group), runs=group, unnamed=unnamed)
        for name, group in zip(names, groups, strict=True)
    ]


def _shortened(values: Sequence[str]) -> Sequence[str]:
    """Return the values of the groups, shortened if different ones stay different."""
    cut = [value if len(value) <= _LONGEST_VALUE else f"{value[: _LONGEST_VALUE - 3]}..." for value in values]
    return cut if len(set(cut)) == len(set(values)) else values


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


def _text(group: Sequence[RecordedRun], key: str) -> str:
    """Return the values of a setting in a group."""
    return "/".join(sorted({value_text(run.setting(key)) for run in group}))


def _sortable(value: Any) -> tuple[int, float, str]:
    if isinstance(value, int | float):
        return 0, float(value), ""
    return 1, 0.0, value_text(value)


def select(
    parts: Sequence[Sequence[Path]],
    *,
    finished: bool,
    columns: Sequence[str] = (),
    keys: Sequence[str] = (),
    read: Callable[[Path, Sequence[str]], Run] = read_run,
) -> tuple[list[list[Group[Run]]], list[str]]:
    """Return the groups of the runs that paths name, of each environment, and one line for what is left out.

    Args:
      parts: paths as `find_runs` takes them. One part is grouped by settings; several parts are groups.
      finished: leave out unfinished runs.
      columns: columns of the metrics that are needed.
      keys: settings that name the groups, if there is one part (default: those that differ).
      read: reads a run directory: `read_run`, or `read_record` for all that it records.

    Raises RunDataError if a path is no run directory, or no run of a part is left.
    """
    problems: list[str] = []

    def usable(directory: Path) -> Run | None:
        try:
            run = read(directory, columns)
        except RunDataError as error:
            problems.append(str(error))
            return None
        if finished and run.unfinished:
            problems.append(run.unfinished)
            return None
        return run

    runs = [[run for run in map(usable, find_runs(part)) if run is not None] for part in parts]
    if not all(runs):
        more = f" ({len(problems) - 1} more runs cannot be used either)" if len(problems) > 1 else ""
        raise RunDataError(f"{problems[0]}{more}")
    found: list[list[Group[Run]]] = []
    for played in _by_environment(runs):
        found.append(by_settings(played[0], keys) if len(played) == 1 else by_user([part for part in played if part]))
        problems += [
            f"group {number} has no run of {environment_of(found[-1]) or 'an unknown environment'}"
            for number, part in enumerate(played, start=1)
            if not part
        ]
    return found, [f"left out: {problem}" for problem in problems]
