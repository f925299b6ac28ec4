"""The report of one or more runs: one HTML file that loads nothing and runs nothing.

Elements are those of xml.etree, which escapes every text and attribute as it writes the file: a name or a setting that
comes from outside cannot become markup.
"""

import base64
import math
import shlex
import xml.etree.ElementTree as ET
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from daedalus.analysis.charts import LARGE, SERIES_COLOURS, SMALL, histogram, line_chart
from daedalus.analysis.comparison import Comparison, cells, compare_groups, header, notes
from daedalus.analysis.learning_curves import DEVIATION, LARGEST, Series, series_of, title_of
from daedalus.analysis.recorded_run import ENVIRONMENT, RATING, RETURN, RunRecord, finite
from daedalus.analysis.run_groups import Group, environment_of
from daedalus.analysis.run_results import (
    EpisodeStatistics,
    episode_statistics,
    failed_events,
    failure_counts,
    interval_text,
    statistics_rows,
    together,
    written,
)
from daedalus.learner.reporting.metrics_rows import ENV, LESSON, USER, WIN_RATE
from daedalus.learner.run.run_directory import CONFIG
from daedalus.learner.run.settings import changed_settings, setting_text, value_text
from daedalus.learner.serving.events import DRAINED_BY, ORDERED_BY, STOPPED_BY
from daedalus.protocol.league import NEWEST, LeagueStatus, Score
from daedalus.protocol.texts import printable, short_share

_STYLE = Path(__file__).with_name("report_style.css")
# The browser itself enforces that the page loads nothing from elsewhere and runs no script.
_POLICY = (
    "default-src 'none'; style-src 'unsafe-inline'; img-src data:; media-src data:; base-uri 'none'; form-action 'none'"
)
MAX_VIDEO_BYTES = 32 << 20
_MOST_EVENTS = 200
_TITLES = {
    RETURN: "return of the training episodes",
    "episode_length_mean": "length of the training episodes (env_steps)",
    "entropy": "entropy (nats)",
    "value_loss": "value loss",
    "policy_loss": "policy loss",
    "explained_variance": "explained variance of the returns",
    "policy_lag_mean": "policy lag (updates)",
    "behaviour_kl": "KL divergence of behaviour and target policy (nats)",
    "gradient_norm": "norm of the gradient",
    "learning_rate": "learning rate",
    "env_steps_per_second": "env_steps per second",
    "actors": "live actors",
    "rollouts_rejected": "rejected rollouts",
    "updates_skipped": "skipped updates",
}
_MOST_OWN = 24  # columns of the environment, of the user and of opponents
_STRONGEST = 45  # percent of the colour in a cell of a matrix, so that its text can be read

Child = str | int | float | None | ET.Element | Iterable["Child"]


def run_page(group: Group[RunRecord], by: str) -> str:
    """Return the report of one run.

    Args:
      group: the run alone, with the name that the curves have.
      by: horizontal axis of the curves, "env_steps" or "minutes".
    """
    (record,) = group.runs
    settings = record.settings
    seed, actors = settings.get("training.seed"), settings.get("collection.actors")
    facts = [
        settings.get(ENVIRONMENT),
        settings.get("training.algorithm"),
        None if seed is None else f"seed {seed}",
        None if actors is None else f"{actors} actors",
    ]
    unfinished = record.unfinished
    return _document(
        record.name,
        _header(record.name, facts, record.status),
        element("p", unfinished, class_="note") if unfinished else None,
        summary_tiles(record),
        element("p", record.bottleneck, class_="muted") if record.bottleneck else None,
        league_section(group, by),
        return_section([group], by),
        video_section(record),
        evaluation_section(record),
        _curves([group], by),
        orders_section(record),
        failure_section(record),
        settings_section(record),
        versions_section(record),
        repeat_section(record),
    )


def comparison_page(
    environments: Sequence[Sequence[Group[RunRecord]]],
    by: str,
    *,
    threshold: float | None,
    left_out: Sequence[str],
) -> str:
    """Return the report of several runs.

    Args:
      environments: the runs of each environment, one curve for each group.
      by: horizontal axis of the curves, "env_steps" or "minutes".
      threshold: mean return to reach, for the table (default: the target return of the runs).
      left_out: one line for each run that could not be read.
    """
    groups = [group for groups in environments for group in groups]
    runs = [run for group in groups for run in group.runs]
    several = len(environments) > 1
    played = f"{len(environments)} environments" if several else environment_of(groups)
    title = f"{len(runs)} runs of {played}" if played else f"{len(runs)} runs"
    unfinished = [run.unfinished for run in runs if run.unfinished]
    sections = [_environment_sections(each, by, threshold, named=several) for each in environments]
    return _document(
        title,
        _header(title, [f"{len(groups)} groups" if len(groups) > 1 else "1 group"], None),
        [element("p", line, class_="note") for line in [*left_out, *unfinished]],
        sections,
        versions_of_runs_section(groups),
    )


def _environment_sections(
    groups: Sequence[Group[RunRecord]], by: str, threshold: float | None, *, named: bool
) -> list[ET.Element | None]:
    """Return what a report of several runs shows of one environment, under its name if there are several."""
    environment = environment_of(groups) or "unknown environment"
    heading = element("h2", environment, class_="environment") if named else None
    return [
        heading,
        return_section(groups, by, environment if named else ""),
        comparison_section(comparison_of(groups, threshold)),
        _curves(groups, by, environment if named else ""),
        runs_section(groups),
        differences_section(groups),
    ]


def section(title: str, *content: Child) -> ET.Element:
    """Return a section with a heading."""
    return element("section", element("h2", title), *content)


def tiles(values: Sequence[tuple[str, str, str]]) -> ET.Element:
    """Return numbers in large type: name, value and an explanation each."""
    return element(
        "dl",
        [
            element(
                "div", element("dt", name), element("dd", value, class_="value"), element("dd", more, class_="more")
            )
            for name, value, more in values
        ],
        class_="tiles",
    )


def summary_tiles(record: RunRecord) -> ET.Element:
    """Return the numbers that say most about a run."""
    values = []
    if record.evaluation is not None:
        statistics = episode_statistics(record.evaluation)
        mean, _, _ = statistics.mean
        more = f"mean ± std of {record.evaluation.episodes:,} {record.evaluation.actions} episodes"
        values.append(("evaluation", f"{written(mean)} ± {written(statistics.std)}", more))
        if statistics.interquartile is not None:
            value, low, high = statistics.interquartile
            interval = "" if math.isnan(low) else f"95 % interval {interval_text(low, high)}"
            values.append(("interquartile mean", written(value), interval))
    rating, deviation = record.number(RATING), record.number(DEVIATION)
    if rating is not None:
        values.append(("rating", f"{rating:,.0f} ± {deviation or 0.0:,.0f}", "of the newest policy in its league"))
    trained = record.number("episode_return_mean")
    values.append(("training", written(trained), "mean return of the newest episodes"))
    budget = record.settings.get("training.env_steps")
    of_budget = f"of {budget:,}" if isinstance(budget, int) else ""
    values.append(("env_steps", written(record.number("env_steps")), of_budget))
    seconds = record.number("wall_seconds")
    rate = record.number("env_steps_per_second")
    duration = "-" if seconds is None else _duration(seconds)
    values.append(("duration", duration, f"{written(rate)} env_steps/s" if rate is not None else ""))
    values.append(("updates", written(record.number("updates")), f"{written(record.number('episodes'))} episodes"))
    return tiles(values)


def _duration(seconds: float) -> str:
    if seconds < 90:
        return f"{seconds:.1f} s"
    return f"{seconds / 60:.1f} min" if seconds < 5400 else f"{seconds / 3600:.1f} h"


def evaluation_section(record: RunRecord) -> ET.Element:
    """Return the evaluation: a histogram and the statistics of its episodes."""
    evaluation = record.evaluation
    if evaluation is None:
        how = [
            "No evaluation is recorded. Evaluate the run with: ",
            element("code", record.record_command),
        ]
        return section("Evaluation", element("p", how, class_="note"))
    statistics = episode_statistics(evaluation)
    best = "best" if evaluation.best_checkpoint else "newest"
    played = (
        f"{evaluation.episodes:,} {evaluation.actions} episodes of the {best} checkpoint, policy version "
        f"{evaluation.policy_version}, on {evaluation.environment} (backend {evaluation.backend})"
        + ("" if evaluation.seed is None else f", seed {evaluation.seed}")
    )
    numbers = table((), statistics_rows(evaluation, statistics), label="statistics of the evaluation", numeric={1})
    return section(
        "Evaluation",
        element("p", played, class_="muted"),
        [element("p", note, class_="note") for note in evaluation.notes],
        element("div", _returns(record, statistics), element("div", numbers, _confirmation(record)), class_="pair"),
    )


def _returns(record: RunRecord, statistics: EpisodeStatistics) -> ET.Element:
    assert record.evaluation is not None
    if statistics.interquartile is None:
        how = "The returns of the episodes are not recorded, so there is no histogram. Evaluate the run again with: "
        return element("p", how, element("code", record.record_command), class_="note")
    returns = np.array(record.evaluation.returns)
    if not (np.abs(returns) < LARGEST).all():
        return element("p", "The returns are too large for a histogram.", class_="note")
    marks = [("mean", statistics.mean.value), ("interquartile mean", statistics.interquartile.value)]
    title = "episodes by return"
    chart = histogram(title, returns, marks=marks, unit="return")
    return element("div", _figure(title, chart), _legend([("mean", 2, False), ("interquartile mean", 3, True)]))


def _confirmation(record: RunRecord) -> ET.Element | None:
    """Return the sentence about the episodes that confirm "solved", if there are any."""
    mean, episodes = (finite(record.confirmation.get(name)) for name in ("return_mean", "episodes"))
    if mean is None or episodes is None:
        return None
    words = (
        f"Confirmation: mean return {written(mean)} over {written(episodes)} new sampled episodes of the policy at "
        "which training stopped"
    )
    interval = record.confirmation.get("interval")
    ends = [finite(end) for end in interval] if isinstance(interval, list) else []
    if len(ends) == 2 and ends[0] is not None and ends[1] is not None:
        words += f", 95 % interval {interval_text(ends[0], ends[1])}"
    return element("p", f"{words}.", class_="muted")


def video_section(record: RunRecord) -> ET.Element | None:
    """Return the video, embedded, or None without one."""
    video = record.video
    if video is None:
        return None
    if video.size > MAX_VIDEO_BYTES:
        words = (
            f"{video.path.name} has {video.size / 2**20:.0f} MiB, and a report embeds at most "
            f"{MAX_VIDEO_BYTES >> 20} MiB: record a shorter one with --max-seconds, or a smaller one with --width."
        )
        return section("Video", element("p", words, class_="note"))
    source = f"data:{video.media_type};base64,{base64.b64encode(video.path.read_bytes()).decode()}"
    name = f"episodes of this run ({video.path.name})"
    if video.media_type == "image/gif":
        return section("Video", element("img", src=source, alt=name, class_="video"))
    return section("Video", element("video", src=source, controls=True, loop=True, muted=True, aria_label=name))


def orders_section(record: RunRecord) -> ET.Element | None:
    """Return the orders of operators and who gave them; None without any."""
    given = [each for each in record.events if each.text.startswith((ORDERED_BY, DRAINED_BY, STOPPED_BY))]
    if not given:
        return None
    rows = [(each.time, each.actor or "the run", each.kind, each.text) for each in given[-_MOST_EVENTS:]]
    more = len(given) - len(rows)
    left_out = element("p", f"{more:,} earlier ones are in events.jsonl.", class_="muted") if more > 0 else None
    listed = table(("at (UTC)", "about", "event", "order"), rows, label="orders of operators")
    return section("Orders of operators", listed, left_out)


def failure_section(record: RunRecord) -> ET.Element:
    """Return what failed during the run."""
    counts = failure_counts(record)
    events = together(failed_events(record.events))
    content: list[Child] = []
    if counts:
        rows = [(each.name, f"{each.count:,}", each.detail) for each in counts]
        content.append(table(("failure", "count", "detail"), rows, label="failures by kind", numeric={1}))
    else:
        content.append(element("p", "Nothing that the run directory records failed."))
    if not record.events:
        content.append(element("p", "This run recorded no events: actors and restarts are unknown.", class_="muted"))
    if events:
        rows = [
            (each.first.time, each.first.kind, each.first.actor, each.first.text, f"{each.count:,}") for each in events
        ]
        more = len(rows) - _MOST_EVENTS
        listed = table(
            ("first at (UTC)", "event", "actor", "what happened", "count"),
            rows[:_MOST_EVENTS],
            label="events",
            numeric={4},
        )
        left_out = element("p", f"{more:,} more are in events.jsonl.", class_="muted") if more > 0 else None
        content.append(element("details", element("summary", f"{len(rows):,} events"), listed, left_out))
    if record.output:
        printed = element("pre", record.output, tabindex=0)
        content.append(element("details", element("summary", "what actors and evaluations printed last"), printed))
    return section("What failed meanwhile", *content)


def settings_section(record: RunRecord) -> ET.Element:
    """Return the settings of the run: those that differ from the defaults, and all others below a heading to open."""
    changed = set(changed_settings(record.settings))
    known = {path: value for path, value in record.settings.items() if value is not None}
    others = {path: value for path, value in known.items() if path not in changed}
    return section(
        "Settings that differ from the defaults",
        _settings_columns("settings", {path: value for path, value in known.items() if path in changed}),
        element(
            "details",
            element("summary", f"{len(others)} settings at their defaults"),
            _settings_columns("defaults", others),
        ),
    )


def _settings_columns(label: str, settings: Mapping[str, object]) -> ET.Element:
    """Return a table of settings for each section. `label` says what they are, for screen readers."""
    parts: dict[str, list[tuple[str, str]]] = {}
    for path, value in settings.items():
        part, _, name = path.partition(".")
        parts.setdefault(part, []).append((name, setting_text(value)))
    columns = [
        element("div", element("h3", part), table((), rows, label=f"{label}: {part}"), class_="card")
        for part, rows in parts.items()
    ]
    return element("div", columns, class_="columns")


def versions_section(record: RunRecord) -> ET.Element | None:
    """Return the versions of the packages that the run was started with, or None if they are not recorded."""
    if not record.versions:
        return None
    versions = table((), record.versions.items(), label="versions")
    return section("Versions", element("details", element("summary", f"{len(record.versions)} versions"), versions))


def repeat_section(record: RunRecord) -> ET.Element:
    """Return the commands that train and evaluate the same again."""
    origin = record.versions.get("init_from")
    others = ["--allow-other-spaces"] if record.versions.get("init_from_other_spaces") else []
    begun = ["--init-from", origin, *others] if origin else []
    begun += ["--demonstrations", record.dataset] if record.dataset else []
    train = shlex.join(["daedalus", "train", str(record.directory / CONFIG), *begun])
    trust = "The run has code of its author: allow its modules only if you trust that code."
    return section(
        "Do it again",
        element("pre", f"{train}\n{record.evaluate_command}", tabindex=0),
        element("p", trust, class_="note") if "--allow-module" in record.evaluate_command else None,
    )


def comparison_of(groups: Sequence[Group], threshold: float | None) -> Comparison | None:
    """Return the comparison of the finished runs, or None if no run has finished."""
    finished = [replace(group, runs=[run for run in group.runs if not run.unfinished]) for group in groups]
    finished = [group for group in finished if group.runs]
    return compare_groups(finished, threshold) if finished else None


def comparison_section(comparison: Comparison | None) -> ET.Element:
    """Return the table of the groups, with intervals."""
    if comparison is None:
        return section(
            "Comparison", element("p", "No run has finished, so there is nothing to compare yet.", class_="note")
        )
    rows = [cells(result, comparison) for result in comparison.results]
    explained = [element("li", line) for line in notes(comparison)]
    return section(
        "Comparison",
        table(
            header(comparison), rows, label=f"comparison of the groups of {comparison.environment}", numeric=range(1, 7)
        ),
        element("ul", explained, class_="muted"),
    )


def runs_section(groups: Sequence[Group[RunRecord]]) -> ET.Element:
    """Return the table of the runs."""
    head = ("run", "group", "seed", "status", "env_steps", "minutes", "training", "evaluation", "failures")
    rows = []
    for group in groups:
        for record in group.runs:
            seconds = record.number("wall_seconds")
            failures = ", ".join(f"{each.name}: {each.count:,}" for each in failure_counts(record))
            rows.append(
                (
                    record.name,
                    group.name,
                    value_text(record.settings.get("training.seed")),
                    record.status,
                    written(record.number("env_steps")),
                    written(None if seconds is None else seconds / 60.0),
                    written(record.number("episode_return_mean")),
                    _evaluated(record),
                    failures or "none",
                )
            )
    return section("Runs", table(head, rows, label=f"runs of {environment_of(groups)}", numeric=(2, 4, 5, 6, 7)))


def _evaluated(record: RunRecord) -> str:
    if record.evaluation is None:
        return written(record.number("evaluation_return_mean"))
    return f"{written(record.evaluation.return_mean)} ± {written(record.evaluation.return_std)}"


def differences_section(groups: Sequence[Group]) -> ET.Element | None:
    """Return the settings in which the groups differ, or None if there are none."""
    known = sorted({key for group in groups for run in group.runs for key in run.settings} - {"training.seed"})
    rows = [(key, *(_values(group, key) for group in groups)) for key in known]
    rows = [row for row in rows if len(set(row[1:])) > 1]
    if not rows:
        return None
    head = ("setting", *(group.name for group in groups))
    return section("Settings that differ", table(head, rows, label=f"settings of {environment_of(groups)} that differ"))


def _values(group: Group, key: str) -> str:
    return " / ".join(sorted({setting_text(run.settings.get(key)) for run in group.runs}))


def versions_of_runs_section(groups: Sequence[Group[RunRecord]]) -> ET.Element | None:
    """Return the versions of the packages, one column for each set of versions that runs were started with."""
    columns: dict[tuple[tuple[str, str], ...], list[str]] = {}
    for group in groups:
        for record in group.runs:
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


def return_section(groups: Sequence[Group], by: str, of: str = "") -> ET.Element:
    """Return the chart of the return, large, with its explanation; `of` tells charts of the page apart."""
    several = len(groups) > 1 or len(groups[0].runs) > 1
    band = "The band is one standard deviation of the newest episodes, circles are evaluations."
    if several:
        band = "A line of several runs is their interquartile mean, its band the 95 % bootstrap interval."
        if any(len(group.runs) == 1 for group in groups):
            band += " A line of one run has one standard deviation of the newest episodes, and circles for evaluations."
    chart = _large_chart(groups, RETURN, _TITLES[RETURN], by, of)
    return section(
        "Return",
        _legend([_key_of(group, index) for index, group in enumerate(groups)]) if several else None,
        element("p", "No episode has ended: there is no return.", class_="note") if chart is None else chart,
        element("p", band, class_="muted"),
    )


def _large_chart(groups: Sequence[Group], column: str, title: str, by: str, of: str = "") -> ET.Element | None:
    """Return the chart of a column as wide as the page, or None if it has no values."""
    lines, colours = _lines(groups, column, by)
    # Two sizes, so that texts have the same size on a wide and on a narrow page: each shows one of them.
    sizes = (("on-wide", LARGE), ("on-narrow", SMALL))
    drawn = [
        element("div", line_chart(_named(title, of), lines, unit=by, colours=colours, size=size), class_=name)
        for name, size in sizes
        if lines
    ]
    return element("figure", element("figcaption", title), drawn, class_="chart") if drawn else None


def league_section(group: Group[RunRecord], by: str) -> ET.Element | None:
    """Return the rating of a run over its training, its players and who beats whom; None without opponents."""
    (record,) = group.runs
    chart, league = _large_chart([group], RATING, "rating of the newest policy", by), record.league
    if chart is None and league is None:
        return None
    explained = (
        "A player with 200 points more wins 76 of 100 matches. Its skill is within ± of its rating in two of three "
        "cases; the band is this deviation."
    )
    if league is None:
        players = element("p", "The learner records the results between the players at its end.", class_="note")
        return section("League", chart, element("p", explained, class_="muted"), players)
    scores = league.scores_of(NEWEST)
    rows = [
        (
            each.player,
            each.text.replace("+-", "±"),
            f"{each.matches:,}",
            short_share(scores[each.player].win_rate) if each.player in scores else "-",
        )
        for each in sorted(league.players, key=lambda each: -each.rating)
    ]
    more = f"{league.left_out:,} more players are not shown." if league.left_out else ""
    return section(
        "League",
        chart,
        element("p", explained, class_="muted"),
        table(("player", "rating", "matches", "newest wins"), rows, label="players by rating", numeric={1, 2, 3}),
        element("p", more, class_="muted") if more else None,
        _win_rates(league),
    )


def _win_rates(league: LeagueStatus) -> ET.Element:
    """Return the matrix of win rates, coloured, with the results in the tooltip of each cell."""
    names = [each.player for each in league.players]
    rows = []
    for first in names:
        scores = league.scores_of(first)
        cells = [_win_rate(scores.get(second)) if second != first else "" for second in names]
        rows.append((first, *cells))
    title = "win rates in percent: of the player of a row against that of a column; a draw is half a win"
    head = ("wins of, against", *(element("span", name) for name in names))
    matrix = table(head, rows, label=title, numeric=range(1, len(names) + 1))
    matrix.set("class", "scroll matrix")
    return element("figure", element("figcaption", title), matrix, class_="chart")


def _win_rate(score: Score | None) -> Child:
    if score is None:
        return element("span", "-")
    rate = score.win_rate
    results = f"{score.wins:.4g} won, {score.draws:.4g} drawn, {score.losses:.4g} lost"
    return element(
        "span",
        short_share(rate).removesuffix("%"),
        class_="wins" if rate >= 0.5 else "loses",
        style=f"--share: {_STRONGEST * abs(2 * rate - 1):.0f}%",
        title=f"{score.first} against {score.second}: {short_share(rate)} of {score.matches:.4g} matches ({results})",
    )


def _named(title: str, of: str) -> str:
    return f"{of}: {title}" if of else title


def _curves(groups: Sequence[Group], by: str, of: str = "") -> ET.Element | None:
    """Return a chart of each other column of the metrics that has values, or None if there is none.

    `of` tells charts of the page apart.
    """
    columns = {name for group in groups for run in group.runs for name in run.metrics}
    own = sorted(name for name in columns if name.startswith((ENV, USER, WIN_RATE, LESSON)))[:_MOST_OWN]
    charts = []
    for column, title in {**_TITLES, **{name: title_of(name) for name in own}}.items():
        lines, colours = _lines(groups, column, by)
        if column != RETURN and any(series.y.any() for series in lines):  # all 0: nothing of the kind happened
            charts.append(_figure(title, line_chart(_named(title, of), lines, unit=by, colours=colours)))
    return section("Learning curves", element("div", charts, class_="charts")) if charts else None


def _lines(groups: Sequence[Group], column: str, by: str) -> tuple[list[Series], list[int]]:
    """Return the lines of the groups that have values of a column, and their colours."""
    found = [(series, index) for index, group in enumerate(groups) if (series := series_of(group, column, by))]
    return [series for series, _ in found], [index for _, index in found]


def _key_of(group: Group, index: int) -> tuple[str, int, bool]:
    return group.label, index % SERIES_COLOURS + 1, index >= SERIES_COLOURS


def _legend(keys: Iterable[tuple[str, int, bool]]) -> ET.Element:
    """Return the names of lines, with their colours: name, number of the colour and whether the line is dashed."""
    items = []
    for name, colour, dashed in keys:
        style = f"border-top: 2.5px {'dashed' if dashed else 'solid'} var(--series-{colour})"
        items.append(element("li", element("span", class_="key", style=style), name))
    return element("ul", items, class_="legend")


def _figure(title: str, chart: ET.Element) -> ET.Element:
    return element("figure", element("figcaption", title), chart, class_="chart")


def _header(title: str, facts: Sequence[object], status: str | None) -> ET.Element:
    known = " · ".join(str(fact) for fact in facts if fact not in (None, ""))
    chip = element("span", status, class_="status", data_status=status) if status else None
    return element(
        "header",
        element("div", element("h1", title), chip, class_="bar"),
        element("p", known, class_="muted"),
    )


def _document(title: str, *content: Child) -> str:
    heading, *sections = content
    head = element(
        "head",
        element("meta", charset="utf-8"),
        element("meta", http_equiv="Content-Security-Policy", content=_POLICY),
        element("meta", name="viewport", content="width=device-width, initial-scale=1"),
        element("meta", name="color-scheme", content="light dark"),
        element("title", f"{title}: report of daedalus"),
        element("style", _STYLE.read_text("utf-8")),
    )
    footer = element("footer", "made by ", element("code", "daedalus report"))
    body = element("body", heading, element("main", sections), footer)
    page = element("html", head, body, lang="en")
    return f"<!doctype html>\n{ET.tostring(page, 'unicode', method='html')}\n"


def element(name: str, /, *children: Child, **attributes: str | float | bool | None) -> ET.Element:
    """Return an element of HTML.

    What is not printable in a text is escaped: it is not allowed in HTML, or it reorders or hides the text around it.

    Args:
      name: of the element.
      children: texts, elements, or iterables of them; None is left out.
      attributes: `class_` is class, `aria_label` is aria-label; None and False leave an attribute out.
    """
    made = ET.Element(name)
    for key, value in attributes.items():
        if value is not None and value is not False:
            made.set(key.strip("_").replace("_", "-"), "" if value is True else printable(str(value)))
    for child in _flat(children):
        if isinstance(child, ET.Element):
            made.append(child)
        elif len(made):
            made[-1].tail = (made[-1].tail or "") + child
        else:
            made.text = (made.text or "") + child
    return made


def _flat(child: Child) -> Iterator[str | ET.Element]:
    if isinstance(child, ET.Element):
        yield child
    elif isinstance(child, str | int | float):
        yield printable(str(child))
    elif child is not None:
        for each in child:
            yield from _flat(each)


def table(
    header: Iterable[Child], rows: Iterable[Iterable[Child]], *, label: str, numeric: Collection[int] = ()
) -> ET.Element:
    """Return a table whose first column names its rows, in a region that scrolls where it is too wide.

    Args:
      header: of the columns; empty for a table of names and values.
      rows: the cells.
      label: what the table shows, for screen readers.
      numeric: columns of numbers, counted from 0; they are aligned to the right.
    """
    head = [element("th", cell, scope="col", class_=_kind(index, numeric)) for index, cell in enumerate(header)]
    body = []
    for first, *rest in rows:
        cells = [element("td", cell, class_=_kind(index, numeric)) for index, cell in enumerate(rest, start=1)]
        body.append(element("tr", element("th", first, scope="row"), cells))
    content = element("table", element("thead", element("tr", head)) if head else None, element("tbody", body))
    return element("div", content, class_="scroll", role="region", aria_label=label, tabindex=0)


def _kind(column: int, numeric: Collection[int]) -> str | None:
    return "number" if column in numeric else None
