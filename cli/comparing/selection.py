"""Choice of the runs that a command line names: read them, leave out what cannot be used, and group them."""

from collections.abc import Sequence
from pathlib import Path

from daedalus.cli.comparing.grouping import Group, by_settings, by_user, check_comparable
from daedalus.cli.comparing.recorded_run import RecordedRun, find_runs, read_run
from daedalus.learner.run.run_files import RunDataError


def select(
    parts: Sequence[Sequence[Path]],
    *,
    finished: bool,
    columns: Sequence[str] = (),
    keys: Sequence[str] = (),
) -> tuple[list[Group], list[str]]:
    """Return the groups of the runs that paths name, and one line for each run that is left out.

    Args:
      parts: paths of run directories or of folders of them. One part is grouped by settings; several parts are groups.
      finished: leave out unfinished runs.
      columns: columns of the metrics that are needed.
      keys: settings that name the groups, if there is one part (default: those that differ).

    Raises RunDataError if a path is no run directory, no run is left, or the runs play different environments.
    """
    problems: list[str] = []
    read = [_usable(find_runs(part), finished, columns, problems) for part in parts]
    if not all(read):
        raise RunDataError("; ".join(problems[:1]))
    check_comparable([run for part in read for run in part])
    groups = by_settings(read[0], keys) if len(read) == 1 else by_user(read)
    return groups, [f"left out: {problem}" for problem in problems]


def _usable(
    directories: Sequence[Path], finished: bool, columns: Sequence[str], problems: list[str]
) -> list[RecordedRun]:
    usable = []
    for directory in directories:
        try:
            run = read_run(directory, columns)
        except RunDataError as error:
            problems.append(str(error))
            continue
        if finished and run.unfinished:
            problems.append(run.unfinished)
        else:
            usable.append(run)
    return usable
