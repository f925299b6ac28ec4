"""The model card of a policy: README.md with the metadata that the Hub shows as evaluation results. Pure functions.

It is made from the same record as `daedalus report`, without names of actors and hosts. Texts come from outside: they
are escaped for Markdown, and the metadata is written by huggingface_hub, as YAML without tags.
"""

import re
import shlex
from collections.abc import Sequence
from typing import Any

from daedalus.analysis.learning_curves import DEVIATION
from daedalus.analysis.recorded_run import ENVIRONMENT, RATING, RecordedEvaluation, RunRecord
from daedalus.analysis.run_results import episode_statistics, failure_counts, statistics_rows, written
from daedalus.learner.run.settings import setting_text
from daedalus.policy.saving.hub import LIBRARY
from daedalus.policy.user_modules import allow_words, modules_of
from daedalus.protocol.spec import RunSpec
from daedalus.protocol.texts import one_line, short_share

_TASK = "reinforcement-learning"
_SHOWN_SECTIONS = ("environment", "policy", "collection", "training")


def model_card(record: RunRecord, spec: RunSpec, repository: str, video: str | None) -> str:
    """Return the content of README.md.

    Args:
      record: the run; its evaluation, if it has one, is that of the policy.
      spec: specification that is saved with the policy.
      repository: USER/NAME.
      video: name of the video in the repository, or None.
    """
    environment, algorithm = spec.environment.id, spec.training.algorithm
    parts = [
        f"---\n{_metadata(record, spec, repository)}\n---",
        f"# {plain(algorithm)} on {plain(environment)}",
        f"A policy for {code(environment)}, trained with {code(algorithm)} by Daedalus.",
        _video(video),
        _results(record.evaluation),
        _use(spec, repository),
        _training(record, spec),
        _settings(record),
        _versions(record),
    ]
    return "\n\n".join(part for part in parts if part) + "\n"


def _metadata(record: RunRecord, spec: RunSpec, repository: str) -> str:
    """Return the YAML, with the results in the form in which other libraries of reinforcement learning give them."""
    from huggingface_hub import EvalResult, ModelCardData

    environment, algorithm = _line(spec.environment.id), _line(spec.training.algorithm)
    metrics: list[tuple[str, str, Any]] = []
    if record.evaluation is not None:
        statistics = episode_statistics(record.evaluation)
        metrics.append(
            (
                "mean_reward",
                "mean_reward",
                f"{_plain_number(statistics.mean.value)} +/- {_plain_number(statistics.std)}",
            )
        )
        if statistics.interquartile is not None:
            middle = statistics.interquartile
            name = f"interquartile mean of {record.evaluation.episodes} episodes"
            if middle.low == middle.low:
                name += f" (95 % interval {_plain_number(middle.low)} to {_plain_number(middle.high)})"
            metrics.append(("interquartile_mean_reward", name, middle.value))
    results = [
        EvalResult(
            task_type=_TASK,
            task_name=_TASK,
            dataset_type=environment,
            dataset_name=environment,
            metric_type=kind,
            metric_name=name,
            metric_value=value,
        )
        for kind, name, value in metrics
    ]
    data = ModelCardData(
        library_name=LIBRARY,
        pipeline_tag=_TASK,
        tags=list(dict.fromkeys([environment, algorithm, _TASK, "deep-reinforcement-learning", "daedalus", "onnx"])),
        model_name=repository.partition("/")[2],
        eval_results=results or None,
    )
    return data.to_yaml().strip()


def _plain_number(value: float) -> str:
    """Return a number for a reader that computes with it, without separators: 433.75, 1000001.00 or 2e-05."""
    return f"{value:.2f}" if value == 0.0 or 1.0 <= abs(value) < 1e15 else f"{value:.3g}"


def _video(video: str | None) -> str:
    if video is None:
        return ""
    return "![An episode](replay.gif)" if video.endswith(".gif") else f"An episode: [{video}]({video})"


def _results(evaluation: RecordedEvaluation | None) -> str:
    if evaluation is None:
        return "## Results\n\nNo evaluation is recorded."
    statistics = episode_statistics(evaluation)
    rows = statistics_rows(evaluation, statistics)
    played = (
        f"{evaluation.episodes:,} {plain(evaluation.actions)} episodes on {plain(evaluation.backend)}'s "
        f"{code(evaluation.environment)}"
        + ("" if evaluation.seed is None else f", seed {evaluation.seed}")
        + f", policy version {evaluation.policy_version}. The intervals are about this policy, not about other seeds."
    )
    return "\n\n".join(["## Results", played, _table(("return", ""), rows), *map(plain, evaluation.notes)])


def _use(spec: RunSpec, repository: str) -> str:
    modules = modules_of(spec.environment.user_modules)
    allowed = "".join(f" {shlex.quote(_line(word))}" for word in allow_words(modules))
    lines = [
        f'pip install "{LIBRARY}[hub]"',
        f"daedalus evaluate --from-hub {repository}{allowed}",
        f"daedalus evaluate --from-hub {repository}{allowed} --video play.mp4",
    ]
    given = f", allow_modules={modules!r}" if modules else ""
    python = f'import daedalus\n\npolicy = daedalus.load_policy(from_hub="{repository}"{given})'
    needed = (
        "The environment is in a module of its author's: install the module first, and allow it only if you trust it."
        if modules
        else ""
    )
    return "\n\n".join(
        part for part in ("## Use it", _block(lines, "bash"), _block([python], "python"), needed) if part
    )


def _training(record: RunRecord, spec: RunSpec) -> str:
    seconds = record.number("wall_seconds")
    rating = record.number(RATING)
    rates = record.league.win_rates if record.league else {}
    rows = [
        *(
            []
            if rating is None
            else [("rating in its league", f"{rating:,.0f} ± {record.number(DEVIATION) or 0.0:,.0f}")]
        ),
        *((f"win rate against {name}", short_share(rate)) for name, rate in rates.items()),
        ("env_steps", written(record.number("env_steps"))),
        ("updates", written(record.number("updates"))),
        ("minutes", "-" if seconds is None else f"{seconds / 60.0:.1f}"),
        ("mean return of the last training episodes", written(record.number("episode_return_mean"))),
        ("seed", str(spec.training.seed)),
        *((f"{each.name} (times)", f"{each.count:,}") for each in failure_counts(record)),
    ]
    again = "Train it again with the settings in `config.toml`, with any seed:"
    if record.begun_with:
        begun = record.begun_with.replace("weights", "the weights of another run")
        again = f"The run began with {begun}. Its settings are in `config.toml`; to train with these alone:"
    return "\n\n".join(
        ["## Training", _table(("", ""), rows), again, _block(["daedalus train ./config.toml --seed 2"], "bash")]
    )


def _settings(record: RunRecord) -> str:
    rows = [
        (path, setting_text(value))
        for path, value in record.settings.items()
        if value is not None and path.partition(".")[0] in _SHOWN_SECTIONS and path != ENVIRONMENT
    ]
    if not rows:
        return ""
    return f"<details><summary>Settings</summary>\n\n{_table(('setting', 'value'), rows)}\n\n</details>"


def _versions(record: RunRecord) -> str:
    rows = [
        (name, value)
        for name, value in record.versions.items()
        if name not in ("init_from", "init_from_other_spaces", "processors")
    ]
    if not rows:
        return ""
    return f"<details><summary>Versions</summary>\n\n{_table(('package', 'version'), rows)}\n\n</details>"


def _table(header: tuple[str, str], rows: Sequence[tuple[str, str]]) -> str:
    lines = [
        f"| {header[0]} | {header[1]} |",
        "|---|---|",
        *(f"| {plain(name)} | {plain(value)} |" for name, value in rows),
    ]
    return "\n".join(lines)


def _block(lines: Sequence[str], language: str) -> str:
    return "\n".join([f"```{language}", *lines, "```"])


def _line(text: str) -> str:
    """Return text as one printable line of limited length."""
    return one_line(text)[:400]


def plain(text: str) -> str:
    """Return text that Markdown shows as it is: no markup, no link, no cell of a table ends in it."""
    escaped = re.sub(r"([\\`*{}\[\]#!|~$]|(?<!\w)_|_(?!\w))", r"\\\1", _line(text))
    escaped = escaped.replace("&", "&amp;").replace("<", "&lt;").replace(">", "&gt;")
    return escaped.replace("://", ":&#47;/").replace("@", "&#64;")  # no automatic link, and nobody is notified


def code(text: str) -> str:
    """Return text as inline code."""
    return f"`{_line(text).replace('`', chr(39))}`"
