"""All that a report needs of one run, read from its directory. Nothing in the directory is trusted.

A run directory may come from another machine: only regular files are read, up to a size limit, and checked. Files whose
content a report shows as it is are not read through links, which could lead to any file of the reader's.
"""

import math
import os
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import BaseModel, Field, ValidationError

from daedalus.cli.comparing.recorded_run import RecordedRun, record_command
from daedalus.learner.run.run_directory import EVALUATION, EVENTS, OUTPUT, VERSIONS
from daedalus.learner.run.run_files import RunDataError, read_json
from daedalus.learner.serving.events import RecordedEvent, read_events
from daedalus.policy.saving.regular_files import open_regular
from daedalus.protocol.texts import without_secrets

_MAX_OUTPUT_BYTES = 16 << 10
_VIDEOS = {".mp4": "video/mp4", ".gif": "image/gif"}


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


@dataclass(frozen=True, slots=True, kw_only=True)
class Video:
    """A video in a run directory."""

    path: Path
    media_type: str
    size: int  # in bytes


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class RunRecord:
    """What the directory of one run records."""

    run: RecordedRun
    evaluation: RecordedEvaluation | None  # the last recorded one
    confirmation: Mapping[str, Any]  # of summary.json; empty without one
    versions: Mapping[str, str]
    events: Sequence[RecordedEvent]
    output: str  # the end of what actors and evaluations printed
    video: Video | None

    @property
    def name(self) -> str:
        """Name of the run."""
        return self.run.directory.resolve().name

    @property
    def status(self) -> str:
        """How the run ended, in one word or two."""
        if self.run.unfinished:
            return "not finished"
        return "solved" if self.run.summary.get("solved") else "finished"

    @property
    def rejected(self) -> dict[str, int]:
        """Rejected rollouts of a run that has a summary, by cause."""
        causes = self.run.summary.get("rollouts_rejected")
        if not isinstance(causes, dict):
            return {}
        return {cause: count for cause, count in causes.items() if isinstance(count, int) and count > 0}

    def number(self, name: str) -> float | None:
        """Return a finite number of summary.json, or else the last one of the column of metrics.csv, or None."""
        value = finite(self.run.summary.get(name))
        if value is not None or name not in self.run.metrics:
            return value
        column = self.run.metrics[name]
        known = column[np.isfinite(column)]
        return float(known[-1]) if len(known) else None


def read_record(run: RecordedRun) -> RunRecord:
    """Return what the directory of a run records. Raises RunDataError."""
    directory = run.directory
    try:
        events = list(read_events(directory))
    except OSError as error:
        raise RunDataError(f"{directory / EVENTS}: {error.strerror}") from None
    confirmation = run.summary.get("confirmation")
    versions = read_json(directory / VERSIONS) or {}
    return RunRecord(
        run=run,
        evaluation=_evaluation(directory, run),
        confirmation=confirmation if isinstance(confirmation, dict) else {},
        versions={name: str(value) for name, value in versions.items() if value is not None},
        events=events,
        output=_end_of(directory / OUTPUT),
        video=_video(directory),
    )


def finite(value: Any) -> float | None:
    """Return a value that was read as a float, or None if it is not a finite number."""
    if isinstance(value, bool) or not isinstance(value, int | float):
        return None
    with suppress(OverflowError):
        return float(value) if math.isfinite(value) else None
    return None


def _evaluation(directory: Path, run: RecordedRun) -> RecordedEvaluation | None:
    content = read_json(directory / EVALUATION) or run.summary.get("evaluation")
    if not content:
        return None
    try:
        return RecordedEvaluation.model_validate(content)
    except ValidationError as error:
        first = error.errors()[0]
        where = ".".join(map(str, first["loc"]))
        raise RunDataError(
            f"{directory / EVALUATION} is damaged ({where}: {first['msg']}): write it again with: "
            f"{record_command(directory)}"
        ) from None


def _end_of(path: Path) -> str:
    if path.is_symlink():
        return ""
    try:
        with open_regular(path) as file:
            file.seek(max(os.fstat(file.fileno()).st_size - _MAX_OUTPUT_BYTES, 0))
            return without_secrets(file.read(_MAX_OUTPUT_BYTES).decode("utf-8", "replace").strip())
    except OSError:
        return ""


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
