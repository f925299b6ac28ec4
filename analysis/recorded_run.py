"""A run as its directory records it: settings, metrics and summary, and what a report shows besides.

Nothing in the directory is trusted, because it may come from another machine: only regular files are read, up to a size
limit, and checked. Files whose content a report shows as it is are not read through links, which could lead to any file
of the reader's. Imports no module of a run."""

import csv
import json
import math
import os
import shlex
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from pydantic import BaseModel, Field, ValidationError

from daedalus.analysis.run_selection import one_run
from daedalus.learner.reporting.metrics_rows import MAX_COLUMNS, lasting
from daedalus.learner.reporting.thinning import bounded, line_bytes
from daedalus.learner.run.run_directory import (
    CONFIG,
    DEMONSTRATIONS,
    EVALUATION,
    EVENTS,
    METRICS,
    OUTPUT,
    SUMMARY,
    VERSIONS,
)
from daedalus.learner.run.run_files import RunDataError, read_end, read_json, read_toml
from daedalus.learner.run.run_lock import is_locked
from daedalus.learner.run.settings import SettingsError, flat_settings, run_spec
from daedalus.learner.serving.events import RecordedEvent, read_events
from daedalus.policy.saving.regular_files import open_regular
from daedalus.policy.saving.sealed import DamagedError, SealedDirectory
from daedalus.policy.user_modules import allow_settings
from daedalus.protocol.league import LeagueStatus
from daedalus.protocol.spec import EnvironmentSpec, RunSpec
from daedalus.protocol.texts import bounded_text

SEED, ENVIRONMENT, BEGUN_WITH = "training.seed", "environment.id", "begun_with"
RETURN, ENV_STEPS, SECONDS = "episode_return_mean", "env_steps", "wall_seconds"
RATING = "rating"  # of the newest policy, in games with opponents
EVALUATION_RETURN = "evaluation_return_mean"  # during training

# Numbers that are computed with. Files of other releases, or that somebody changed, may have other values.
_NUMBERS = {"training.env_steps", "training.target_return", "training.target_episodes", SEED}
_SUMMARY_NUMBERS = ("env_steps", "evaluation_return_mean", "seconds_to_target")
_LARGEST = 1e300
_MOST_STEPS = 2.0**63
_MAX_METRICS_BYTES = 4 << 30  # a month of an earlier release, which did not merge old rows
_LONGEST_LINE = MAX_COLUMNS << 8  # bytes
_MAX_OUTPUT_BYTES = 16 << 10
_VIDEOS = {".mp4": "video/mp4", ".gif": "image/gif"}


class NoMetricsError(RunDataError):
    """Error for a run that has made no update yet."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class RecordedRun:
    """One run, from the files in its directory."""

    directory: Path
    settings: Mapping[str, Any]  # by `section.key`; empty without config.toml
    # Columns of metrics.csv, [rows]; NaN: no value. Without rows that a resumed run has undone.
    metrics: Mapping[str, np.ndarray]
    summary: Mapping[str, Any]  # summary.json; empty before the end of training
    begun_with: str | None = None  # besides its settings: `weights` of another run, `demonstrations`, or both

    def setting(self, path: str) -> Any:
        """Return a setting, or the part of one that is a table, such as `environment.kwargs.size`; None if unset.

        A part that is None is "none". BEGUN_WITH is no setting, but tells runs apart as those do.
        """
        if path == BEGUN_WITH:
            return self.begun_with
        section, *keys = path.split(".")
        value = self.settings.get(".".join((section, *keys[:1])))
        for key in keys[1:]:
            value = (
                (value[key] if value[key] is not None else "none")
                if isinstance(value, Mapping) and key in value
                else None
            )
        return value

    @property
    def unfinished(self) -> str:
        """Why the run has no result yet, or an empty string."""
        done = self.metrics[ENV_STEPS][-1]
        budget = self.settings.get("training.env_steps", math.nan)
        ended = self.summary.get("finished") or self.evaluation_return is not None
        if ended and not self.has_gone_on:
            return ""
        running = is_locked(self.directory)
        remedy = "it is still running" if running else f"continue it with: {self.resume_command}"
        author = self.summary.get("stopped_by")
        stopped = f", stopped by {bounded_text(author)}" if isinstance(author, str) and not running else ""
        return f"{self.directory} is not finished ({done:,.0f} of {budget:,.0f} env_steps){stopped}: {remedy}"

    @property
    def has_gone_on(self) -> bool:
        """Whether the run was resumed and has made more steps than its summary says."""
        steps = self.summary.get("env_steps")
        return steps is not None and bool(self.metrics[ENV_STEPS][-1] > steps)

    @property
    def was_stopped(self) -> bool:
        """Whether training was stopped before its end. The run may have been evaluated all the same."""
        return self.summary.get("finished") is False

    @property
    def resume_command(self) -> str:
        """Command that continues the run."""
        modules = {} if self.spec is None else self.spec.user_modules
        return shlex.join(["daedalus", "resume", str(self.directory), *allow_settings(modules)])

    @property
    def evaluate_command(self) -> str:
        """Command that evaluates the run."""
        modules = {} if self.environment is None else self.environment.user_modules
        return shlex.join(["daedalus", "evaluate", str(self.directory), *allow_settings(modules)])

    @property
    def record_command(self) -> str:
        """Command that evaluates the run and records the result in its directory."""
        return f"{self.evaluate_command} --record"

    @property
    def evaluation_return(self) -> float | None:
        """Mean return of the final evaluation, or None without one."""
        return self.summary.get("evaluation_return_mean")

    @property
    def training_return(self) -> float:
        """Mean return of the last training episodes; NaN if no episode has ended."""
        means = self.metrics[RETURN]
        known = means[~np.isnan(means)]
        return float(known[-1]) if len(known) else math.nan

    @property
    def target(self) -> float | None:
        """The target return of the run, or None."""
        return self.settings.get("training.target_return")

    @property
    def spec(self) -> RunSpec | None:
        """The settings; None if this release does not know them."""
        sections = {key.partition(".")[0] for key in self.settings}
        try:
            return RunSpec.model_validate({section: self._section(section) for section in sections})
        except ValidationError:
            return None

    @property
    def environment(self) -> EnvironmentSpec | None:
        """Settings of the environment; None if this release does not know them."""
        try:
            return EnvironmentSpec.model_validate(self._section("environment"))
        except ValidationError:
            return None

    @property
    def trains_true_task(self) -> bool:
        """Whether its training returns can be compared with those of evaluations."""
        return not self.lessons and (self.environment is None or self.environment.trains_true_task)

    @property
    def lessons(self) -> dict[str, Any]:
        """Settings of the lessons, by parameter."""
        return self._section("lessons")

    def _section(self, section: str) -> dict[str, Any]:
        """Return the settings of one section, by name."""
        return {key.partition(".")[2]: value for key, value in self.settings.items() if key.startswith(f"{section}.")}

    def reached(self, threshold: float, *, evaluated: bool = False) -> tuple[float, float]:
        """Return env_steps and minutes until the mean return of the newest training episodes reached a threshold.

        `evaluated` takes the mean returns of evaluations during training; NaN if there was none. Infinite if the mean
        did not reach the threshold. The precision is that of the rows of metrics.csv, except for the target of a run
        that stopped at it. The metrics need wall_seconds.
        """
        at_target = self.summary.get("solved") and threshold == self.target
        steps, seconds = self.summary.get("env_steps"), self.summary.get("seconds_to_target")
        if at_target and self.settings.get("training.stop_when_solved") and steps is not None and seconds is not None:
            return float(steps), seconds / 60.0
        rows = len(self.metrics[ENV_STEPS])
        returns = self.metrics.get(EVALUATION_RETURN, np.full(rows, np.nan)) if evaluated else self.metrics[RETURN]
        if evaluated and np.isnan(returns).all():
            return math.nan, math.nan
        above = returns >= threshold
        episodes = self.metrics.get("episodes")
        if episodes is not None and not evaluated:  # the mean of fewer episodes may be luck
            above &= episodes >= self.settings.get("training.target_episodes", 1)
        if not above.any():
            return math.inf, math.inf
        row = int(above.argmax())
        at = self.metrics.get("evaluation_env_steps", self.metrics[ENV_STEPS]) if evaluated else self.metrics[ENV_STEPS]
        return float(at[row]), float(self.metrics[SECONDS][row]) / 60.0


def read_run(directory: Path, columns: Sequence[str] = ()) -> RecordedRun:
    """Return the run in a directory; its metrics have at least env_steps, the return and `columns`.

    Raises RunDataError.
    """
    return RecordedRun(
        directory=directory,
        settings=read_run_settings(directory),
        metrics=_metrics(directory, (ENV_STEPS, RETURN, *columns)),
        summary=_summary(directory / SUMMARY),
        begun_with=_begun_with(directory),
    )


def _begun_with(directory: Path) -> str | None:
    found = ["demonstrations"] if (directory / DEMONSTRATIONS).is_dir() else []
    with suppress(RunDataError):  # without the file, or if it is damaged, it is not known
        found += ["weights"] if (read_json(directory / VERSIONS) or {}).get("init_from") else []
    return " and ".join(found) or None


def read_metrics(directory: str | Path) -> dict[str, np.ndarray]:
    """Return the metrics of a run, `metrics.csv`, as arrays [rows] by the names of the columns; NaN: no value.

    docs/reference/metrics.md explains the columns. Rows that a resumed run has undone are left out, and old rows of a
    run of many hours are merged.

    Raises RunDataError if the directory has no metrics.
    """
    return dict(read_run(one_run(Path(directory))).metrics)


def read_run_settings(directory: Path) -> dict[str, Any]:
    """Return the settings of a run by `section.key`; empty without config.toml. Raises RunDataError."""
    settings = read_toml(directory / CONFIG)
    if not settings:
        return {}
    try:
        # With the defaults of settings that an earlier release did not have.
        settings = run_spec(settings).model_dump(mode="json")
    except SettingsError:  # another release may have had settings that this one does not have
        settings = json.loads(json.dumps(settings, default=str))  # TOML has dates, too
    return {path: value for path, value in flat_settings(settings).items() if _is_usable(path, value)}


def _is_usable(setting: str, value: Any) -> bool:
    """Return whether a value of config.toml is of the kind that other code relies on."""
    return isinstance(value, str) if setting == ENVIRONMENT else setting not in _NUMBERS or _is_number(value)


def _is_number(value: Any) -> bool:
    return value is None or (isinstance(value, int | float) and abs(value) < _LARGEST)


def _summary(path: Path) -> dict[str, Any]:
    content = read_json(path) or {}
    for name in _SUMMARY_NUMBERS:
        if not _is_number(content.get(name)):
            raise RunDataError(f"{path} is damaged: {name} is not a number")
    return content


def _metrics(directory: Path, columns: Sequence[str]) -> dict[str, np.ndarray]:
    """Return the columns of metrics.csv, [rows]. The line that a running learner is writing is left out.

    A large file of an earlier release, which did not merge old rows, is read as if it had.
    """
    path = directory / METRICS
    nothing = f"{directory} has no metrics yet: wait until the run has made its first updates"
    try:
        with open_regular(path) as file:
            lines = csv.reader(_lines(path, file))
            header = next(lines, [])
            if not header:
                raise NoMetricsError(nothing)
            missing = [column for column in columns if column not in header]
            if missing:
                raise RunDataError(
                    f"{path} has no column {missing[0]}: it is not the metrics of a run, or those of an old release"
                )
            rows = ((line_bytes(row), _numbers(path, lines.line_num, row, len(header))) for row in lines)
            values = bounded(header, rows)
    except FileNotFoundError:
        raise NoMetricsError(nothing) from None
    except OSError as error:
        raise RunDataError(f"{path}: {error.strerror}") from None
    except (UnicodeDecodeError, csv.Error) as error:
        raise RunDataError(f"{path} is damaged: {error}") from None
    if not len(values):
        raise NoMetricsError(nothing)
    found = dict(zip(header, values.T, strict=True))
    if not (np.abs(found.get(ENV_STEPS, values[:0])) < _MOST_STEPS).all():
        raise RunDataError(f"{path} is damaged: {ENV_STEPS} has a value that is no number of steps")
    kept = lasting(*(found[name] for name in (ENV_STEPS, SECONDS) if name in found))
    return {name: column[kept] for name, column in found.items()}


def _lines(path: Path, file: BinaryIO) -> Iterator[str]:
    """Yield the complete lines that a file has now. Raises RunDataError, UnicodeDecodeError."""
    left = os.fstat(file.fileno()).st_size
    if left > _MAX_METRICS_BYTES:
        raise RunDataError(f"{path} is larger than {_MAX_METRICS_BYTES >> 20} MiB, the limit for such a file of a run")
    while left > 0 and (line := file.readline(_LONGEST_LINE)):
        left -= len(line)
        if line.endswith(b"\n"):
            yield line.decode()
        elif len(line) == _LONGEST_LINE:
            raise RunDataError(f"{path} is damaged: it has a line of more than {_LONGEST_LINE >> 10} KiB")


def _numbers(path: Path, line: int, row: Sequence[str], cells: int) -> list[float]:
    if len(row) != cells:
        raise RunDataError(f"{path} is damaged: line {line} has {len(row)} cells, and the header has {cells}")
    try:
        return [float(cell) if cell else math.nan for cell in row]
    except ValueError as error:
        raise RunDataError(f"{path} is damaged: line {line}: {error}") from None


class RecordedGames(BaseModel, allow_inf_nan=False, frozen=True):
    """Games of the policy against an opponent, from every side in turn."""

    games: int = Field(ge=1)
    wins: int = Field(ge=0)
    draws: int = Field(ge=0)
    losses: int = Field(ge=0)
    win_interval: tuple[float, float]  # of the share of games that are won, 95 %


class RecordedMatches(BaseModel, frozen=True):
    """Results of the games of an evaluation."""

    opponent: str
    total: RecordedGames


class RecordedEvaluation(BaseModel, allow_inf_nan=False, frozen=True):
    """Result of `daedalus evaluate --json`. Without the returns of the episodes in runs of earlier releases."""

    environment: str
    backend: str
    policy_version: int
    episodes: int = Field(ge=1)
    actions: str
    seed: int | None = None
    best_checkpoint: bool = False
    notes: tuple[str, ...] = ()
    return_mean: float
    return_std: float
    return_min: float
    return_max: float
    length_mean: float
    returns: tuple[float, ...] = ()
    matches: RecordedMatches | None = None  # of a game with opponents


@dataclass(frozen=True, slots=True, kw_only=True)
class Video:
    """A video in a run directory."""

    path: Path
    media_type: str
    size: int  # in bytes


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class RunRecord(RecordedRun):
    """All that the directory of a run records, for a report."""

    evaluation: RecordedEvaluation | None  # the last recorded one
    confirmation: Mapping[str, Any]  # of summary.json; empty without one
    versions: Mapping[str, str]
    events: Sequence[RecordedEvent]
    output: str  # the end of what actors and evaluations printed
    video: Video | None

    @property
    def name(self) -> str:
        """Name of the run."""
        return self.directory.resolve().name

    @property
    def dataset(self) -> str:
        """Name of the dataset of its demonstrations, in one line; empty without any that can be read."""
        with suppress(DamagedError):
            name = SealedDirectory(self.directory / DEMONSTRATIONS / f"{0:08d}").content.get("dataset")
            return bounded_text(name) if isinstance(name, str) else ""
        return ""

    @property
    def status(self) -> str:
        """How the run ended, in one word or two."""
        if self.unfinished:
            return "not finished"
        return "solved" if self.summary.get("solved") else "finished"

    @property
    def bottleneck(self) -> str:
        """What the run waited for, in one line; empty if it is not known."""
        text = None if self.has_gone_on else self.summary.get("bottleneck")
        return bounded_text(text) if isinstance(text, str) else ""

    @property
    def league(self) -> LeagueStatus | None:
        """Ratings and results of a game with opponents at the end of training; None without any that can be read."""
        try:
            return LeagueStatus.model_validate(None if self.has_gone_on else self.summary.get("league")).bounded()
        except ValidationError:
            return None

    @property
    def rejected(self) -> dict[str, int]:
        """Rejected rollouts of a run that has a summary, by cause."""
        causes = None if self.has_gone_on else self.summary.get("rollouts_rejected")
        if not isinstance(causes, dict):
            return {}
        return {cause: count for cause, count in causes.items() if isinstance(count, int) and count > 0}

    def number(self, name: str) -> float | None:
        """Return a finite number of summary.json, or else the last one of the column of metrics.csv, or None.

        The summary of a run that has gone on since is out of date.
        """
        value = finite(self.summary.get(name))
        if name not in self.metrics or (value is not None and not self.has_gone_on):
            return value
        column = self.metrics[name]
        known = column[np.isfinite(column)]
        return float(known[-1]) if len(known) else None


def read_record(directory: Path, columns: Sequence[str] = ()) -> RunRecord:
    """Return all that a directory records of a run. See `read_run`. Raises RunDataError."""
    run = read_run(directory, columns)
    try:
        events = list(read_events(directory))
    except OSError as error:
        raise RunDataError(f"{directory / EVENTS}: {error.strerror}") from None
    confirmation = run.summary.get("confirmation")
    versions = read_json(directory / VERSIONS) or {}
    return RunRecord(
        directory=directory,
        settings=run.settings,
        metrics=run.metrics,
        summary=run.summary,
        begun_with=run.begun_with,
        evaluation=_evaluation(run),
        confirmation=confirmation if isinstance(confirmation, dict) else {},
        versions={name: str(value) for name, value in versions.items() if value is not None},
        events=events,
        output=read_end(directory / OUTPUT, _MAX_OUTPUT_BYTES),
        video=_video(directory),
    )


def finite(value: Any) -> float | None:
    """Return a value that was read as a float, or None if it is not a finite number."""
    if isinstance(value, bool) or not isinstance(value, int | float):
        return None
    with suppress(OverflowError):
        return float(value) if math.isfinite(value) else None
    return None


def _evaluation(run: RecordedRun) -> RecordedEvaluation | None:
    path = run.directory / EVALUATION
    content = read_json(path) or run.summary.get("evaluation")
    if not content:
        return None
    try:
        return RecordedEvaluation.model_validate(content)
    except ValidationError as error:
        first = error.errors()[0]
        where = ".".join(map(str, first["loc"]))
        raise RunDataError(
            f"{path} is damaged ({where}: {first['msg']}): write it again with: {run.record_command}"
        ) from None


def _video(directory: Path) -> Video | None:
    """Return the newest video in a run directory."""
    found = [
        path
        for path in directory.iterdir()
        if path.suffix.lower() in _VIDEOS and path.is_file() and not (path.is_symlink() or path.name.startswith("."))
    ]
    if not found:
        return None
    newest = max(found, key=lambda path: path.stat().st_mtime_ns)
    return Video(path=newest, media_type=_VIDEOS[newest.suffix.lower()], size=newest.stat().st_size)
