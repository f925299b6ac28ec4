"""The sections of a report about several runs. Pure functions."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

from daedalus.cli.comparing.comparison import Comparison, compare_groups
from daedalus.cli.comparing.grouping import Group, text
from daedalus.cli.comparing.tables import cells, header, notes
from daedalus.cli.reports.axes import written
from daedalus.cli.reports.failures import failure_counts
from daedalus.cli.reports.markup import Html, element, table
from daedalus.cli.reports.run_record import RunRecord
from daedalus.cli.reports.run_sections import section, setting_text

Records = Mapping[Path, RunRecord]  # by run directory


def comparison_of(groups: Sequence[Group], threshold: float | None) -> Comparison | None:
    """Return the comparison of the finished runs, or None if no run has finished."""
    finished = [replace(group, runs=[run for run in group.runs if not run.unfinished]) for group in groups]
    finished = [group for group in finished if group.runs]
    return compare_groups(finished, threshold) if finished else None


def comparison_section(comparison: Comparison | None) -> Html:
    """Return the table of the groups, with intervals."""
    if comparison is None:
        return section(
            "Comparison", element("p", "No run has finished, so there is nothing to compare yet.", class_="note")
        )
    rows = [cells(result, comparison) for result in comparison.results]
    explained = [element("li", line) for line in notes(comparison)]
    return section(
        "Comparison",
        table(header(comparison), rows, label="comparison of the groups", numeric=range(1, 7)),
        element("ul", explained, class_="muted"),
    )


def runs_section(groups: Sequence[Group], records: Records) -> Html:
    """Return the table of the runs."""
    head = ("run", "group", "seed", "status", "env_steps", "minutes", "training", "evaluation", "failures")
    rows = []
    for group in groups:
        for run in group.runs:
            record = records[run.directory]
            seconds = record.number("wall_seconds")
            failures = ", ".join(f"{each.name}: {each.count:,}" for each in failure_counts(record))
            rows.append(
                (
                    record.name,
                    group.name,
                    text(run.settings.get("training.seed")),
                    record.status,
                    written(record.number("env_steps")),
                    written(None if seconds is None else seconds / 60.0),
                    written(record.number("episode_return_mean")),
                    _evaluated(record),
                    failures or "none",
                )
            )
    return section("Runs", table(head, rows, label="runs", numeric=(2, 4, 5, 6, 7)))


def _evaluated(record: RunRecord) -> str:
    if record.evaluation is None:
        return written(record.number("evaluation_return_mean"))
    return f"{written(record.evaluation.return_mean)} ± {written(record.evaluation.return_std)}"


def differences_section(groups: Sequence[Group]) -> Html | None:
    """Return the settings in which the groups differ, or None if there are none."""
    known = sorted({key for group in groups for run in group.runs for key in run.settings} - {"training.seed"})
    rows = [(key, *(_values(group, key) for group in groups)) for key in known]
    rows = [row for row in rows if len(set(row[1:])) > 1]
    if not rows:
        return None
    head = ("setting", *(group.name for group in groups))
    return section("Settings that differ", table(head, rows, label="settings that differ"))


def _values(group: Group, key: str) -> str:
    return " / ".join(sorted({setting_text(run.settings.get(key)) for run in group.runs}))


def versions_of_runs_section(groups: Sequence[Group], records: Records) -> Html | None:
    """Return the versions of the packages, one column for each set of versions that runs were started with."""
    columns: dict[tuple[tuple[str, str], ...], list[str]] = {}
    for group in groups:
        for run in group.runs:
            record = records[run.directory]
            shown = {name: value for name, value in record.versions.items() if not name.startswith("init_from")}
            if shown:
                columns.setdefault(tuple(sorted(shown.items())), []).append(record.name)
    if not columns:
        return None
    names = list(dict.fromkeys(name for versions in columns for name, _ in versions))
    rows = [(name, *(dict(versions).get(name, "-") for versions in columns)) for name in names]
    heads = [runs[0] if len(runs) == 1 else f"{runs[0]} and {len(runs) - 1} more" for runs in columns.values()]
    head = ("package", *heads) if len(columns) > 1 else ()
    return section("Versions", table(head, rows, label="versions"))
