"""The sections of a report about one run. Pure functions, except that the video is read."""

import base64
import json
import math
import shlex
from collections.abc import Sequence

import numpy as np

from daedalus.cli.comparing.grouping import text
from daedalus.cli.comparing.recorded_run import record_command
from daedalus.cli.reports.axes import written
from daedalus.cli.reports.charts import histogram
from daedalus.cli.reports.curves import LARGEST
from daedalus.cli.reports.episodes import EpisodeStatistics, episode_statistics
from daedalus.cli.reports.failures import failed_events, failure_counts, together
from daedalus.cli.reports.markup import Child, Html, element, table
from daedalus.cli.reports.run_record import RecordedEvaluation, RunRecord, finite
from daedalus.learner.run.run_directory import CONFIG
from daedalus.protocol.texts import without_secrets

MAX_VIDEO_BYTES = 32 << 20
_MOST_EVENTS = 200


def section(title: str, *content: Child) -> Html:
    """Return a section with a heading."""
    return element("section", element("h2", title), *content)


def tiles(values: Sequence[tuple[str, str, str]]) -> Html:
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


def summary_tiles(record: RunRecord) -> Html:
    """Return the numbers that say most about a run."""
    values = []
    if record.evaluation is not None:
        statistics = episode_statistics(record.evaluation)
        mean, _, _ = statistics.mean
        more = f"mean ± std of {record.evaluation.episodes:,} {record.evaluation.actions} episodes"
        values.append(("evaluation", f"{written(mean)} ± {written(statistics.std)}", more))
        if statistics.interquartile is not None:
            value, low, high = statistics.interquartile
            interval = "" if math.isnan(low) else f"95 % interval {_interval(low, high)}"
            values.append(("interquartile mean", written(value), interval))
    trained = record.number("episode_return_mean")
    values.append(("training", written(trained), "mean return of the newest episodes"))
    budget = record.run.settings.get("training.env_steps")
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


def evaluation_section(record: RunRecord) -> Html:
    """Return the evaluation: a histogram and the statistics of its episodes."""
    evaluation = record.evaluation
    if evaluation is None:
        how = [
            "No evaluation is recorded. Evaluate the run with: ",
            element("code", record_command(record.run.directory)),
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


def _returns(record: RunRecord, statistics: EpisodeStatistics) -> Html:
    assert record.evaluation is not None
    if statistics.interquartile is None:
        how = "The returns of the episodes are not recorded, so there is no histogram. Evaluate the run again with: "
        return element("p", how, element("code", record_command(record.run.directory)), class_="note")
    returns = np.array(record.evaluation.returns)
    if not (np.abs(returns) < LARGEST).all():
        return element("p", "The returns are too large for a histogram.", class_="note")
    marks = [("mean", statistics.mean.value), ("interquartile mean", statistics.interquartile.value)]
    keys = [element("li", element("span", class_=f"key mark-{index}"), name) for index, (name, _) in enumerate(marks)]
    chart = histogram("episodes by return", returns, marks=marks, unit="return")
    return element("div", chart, element("ul", keys, class_="legend"))


def statistics_rows(evaluation: RecordedEvaluation, statistics: EpisodeStatistics) -> list[tuple[str, str]]:
    """Return the statistics of an evaluation as names and values."""
    mean = statistics.mean
    rows = [
        ("mean", written(mean.value)),
        ("95 % interval of the mean", _interval(mean.low, mean.high)),
        ("standard deviation", written(statistics.std)),
    ]
    if statistics.interquartile is not None:
        middle = statistics.interquartile
        rows += [
            ("interquartile mean", written(middle.value)),
            ("95 % bootstrap interval", _interval(middle.low, middle.high)),
            ("median", written(statistics.median)),
        ]
    rows += [
        ("lowest and highest", _interval(evaluation.return_min, evaluation.return_max)),
        ("mean length (env_steps)", written(evaluation.length_mean)),
    ]
    return rows


def _interval(low: float, high: float) -> str:
    return "-" if low != low or high != high else f"{written(low)} to {written(high)}"


def _confirmation(record: RunRecord) -> Html | None:
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
        words += f", 95 % interval {_interval(ends[0], ends[1])}"
    return element("p", f"{words}.", class_="muted")


def video_section(record: RunRecord) -> Html | None:
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


def failure_section(record: RunRecord) -> Html:
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


def settings_section(record: RunRecord) -> Html:
    """Return all settings of the run, by their sections."""
    parts: dict[str, list[tuple[str, str]]] = {}
    for path, value in record.run.settings.items():
        part, _, name = path.partition(".")
        if value is not None:
            parts.setdefault(part, []).append((name, setting_text(value)))
    columns = [
        element("div", element("h3", part), table((), rows, label=f"settings: {part}"), class_="card")
        for part, rows in parts.items()
        if rows
    ]
    return section("Settings", element("div", columns, class_="columns"))


def setting_text(value: object) -> str:
    """Return the value of a setting as text of limited length."""
    shown = without_secrets(text(value) if not isinstance(value, dict | list) else json.dumps(value))
    return shown if len(shown) <= 400 else f"{shown[:400]}..."


def versions_section(record: RunRecord) -> Html | None:
    """Return the versions of the packages that the run was started with, or None if they are not recorded."""
    if not record.versions:
        return None
    return section("Versions", table((), record.versions.items(), label="versions"))


def repeat_section(record: RunRecord) -> Html:
    """Return the commands that train and evaluate the same again."""
    config, directory = (shlex.quote(str(path)) for path in (record.run.directory / CONFIG, record.run.directory))
    commands = f"daedalus train {config}\ndaedalus evaluate {directory}"
    return section("Do it again", element("pre", commands, tabindex=0))
