"""The page of a report: one HTML file that loads nothing and runs nothing."""

from collections.abc import Sequence
from pathlib import Path

from daedalus.cli.comparing.grouping import Group
from daedalus.cli.comparing.recorded_run import ENVIRONMENT
from daedalus.cli.reports.curves import curves, legend
from daedalus.cli.reports.group_sections import (
    Records,
    comparison_of,
    comparison_section,
    differences_section,
    runs_section,
    versions_of_runs_section,
)
from daedalus.cli.reports.markup import Child, Html, element, escape, join
from daedalus.cli.reports.run_record import RunRecord
from daedalus.cli.reports.run_sections import (
    evaluation_section,
    failure_section,
    repeat_section,
    section,
    settings_section,
    summary_tiles,
    versions_section,
    video_section,
)

_STYLE = Path(__file__).with_name("style.css")
# The browser itself enforces that the page loads nothing from elsewhere and runs no script.
_POLICY = (
    "default-src 'none'; style-src 'unsafe-inline'; img-src data:; media-src data:; base-uri 'none'; form-action 'none'"
)


def run_page(record: RunRecord, group: Group, by: str) -> str:
    """Return the report of one run.

    Args:
      record: the run.
      group: the run alone, with the name that the curves have.
      by: horizontal axis of the curves, "env_steps" or "minutes".
    """
    settings = record.run.settings
    facts = [
        settings.get(ENVIRONMENT),
        settings.get("training.algorithm"),
        *(f"{name} {settings[key]}" for name, key in (("seed", "training.seed"),) if settings.get(key) is not None),
        *(f"{settings[key]} actors" for key in ("collection.actors",) if settings.get(key) is not None),
    ]
    unfinished = record.run.unfinished
    return _document(
        record.name,
        _header(record.name, facts, record.status),
        element("p", unfinished, class_="note") if unfinished else None,
        summary_tiles(record),
        _curves([group], by),
        evaluation_section(record),
        video_section(record),
        failure_section(record),
        settings_section(record),
        versions_section(record),
        repeat_section(record),
    )


def comparison_page(
    groups: Sequence[Group],
    records: Records,
    by: str,
    *,
    threshold: float | None,
    left_out: Sequence[str],
) -> str:
    """Return the report of several runs.

    Args:
      groups: the runs, one curve for each group.
      records: the runs by their directories.
      by: horizontal axis of the curves, "env_steps" or "minutes".
      threshold: mean return to reach, for the table (default: the target return of the runs).
      left_out: one line for each run that could not be read.
    """
    runs = [run for group in groups for run in group.runs]
    comparison = comparison_of(groups, threshold)
    environment = next((run.settings[ENVIRONMENT] for run in runs if ENVIRONMENT in run.settings), "")
    title = f"{len(runs)} runs of {environment}" if environment else f"{len(runs)} runs"
    unfinished = [run.unfinished for run in runs if run.unfinished]
    return _document(
        title,
        _header(title, [f"{len(groups)} groups" if len(groups) > 1 else "1 group"], None),
        [element("p", line, class_="note") for line in [*left_out, *unfinished]],
        comparison_section(comparison),
        _curves(groups, by),
        runs_section(groups, records),
        differences_section(groups),
        versions_of_runs_section(groups, records),
    )


def _curves(groups: Sequence[Group], by: str) -> Html:
    several = len(groups) > 1 or len(groups[0].runs) > 1
    band = "The band is one standard deviation of the newest episodes, circles are evaluations."
    if several:
        band = "A line of several runs is their interquartile mean, its band the 95 % bootstrap interval."
        if any(len(group.runs) == 1 for group in groups):
            band += " A line of one run has one standard deviation of the newest episodes, and circles for evaluations."
    return section(
        "Learning curves",
        element("p", band, class_="muted"),
        legend(groups) if several else None,
        element("div", curves(groups, by), class_="charts"),
    )


def _header(title: str, facts: Sequence[object], status: str | None) -> Html:
    known = " · ".join(str(fact) for fact in facts if fact not in (None, ""))
    chip = element("span", status, class_="status", data_status=status) if status else None
    return element(
        "header",
        element("div", element("h1", title), chip, class_="bar"),
        element("p", known, class_="muted"),
    )


def _document(title: str, header: Html, *content: Child) -> str:
    style = Html(_STYLE.read_text("utf-8"))
    head = element(
        "head",
        element("meta", charset="utf-8"),
        Html(f'<meta http-equiv="Content-Security-Policy" content="{escape(_POLICY)}">'),
        element("meta", name="viewport", content="width=device-width, initial-scale=1"),
        element("meta", name="color-scheme", content="light dark"),
        element("title", f"{title}: report of daedalus"),
        element("style", style),
    )
    footer = element("footer", "made by ", element("code", "daedalus report"))
    body = element("body", header, element("main", join(content)), footer)
    return f"<!doctype html>\n{element('html', head, body, lang='en')}\n"
