"""A folder of runs: what each run is, which are the best, and which can be removed. `daedalus runs` shows it."""

import math
import os
import shutil
import stat
import sys
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from daedalus.analysis.recorded_run import (
    ENV_STEPS,
    ENVIRONMENT,
    RATING,
    NoMetricsError,
    RecordedRun,
    read_run,
    read_run_settings,
)
from daedalus.analysis.run_archive import module_names, parts_of
from daedalus.analysis.run_selection import Labels, read_labels
from daedalus.learner.run.run_directory import VERSIONS, read_config, releases_of
from daedalus.learner.run.run_files import RunDataError, read_json
from daedalus.learner.run.run_lock import RunInUseError, is_locked, lock_idle
from daedalus.learner.run.settings import SettingsError, value_text
from daedalus.policy.saving.best_checkpoints import best_checkpoints, best_in_training
from daedalus.policy.saving.saved_policy import checkpoints
from daedalus.protocol.texts import bounded_text, short_number

# Settings that make the task of evaluations another one, so that returns cannot be compared.
_IN_TRAINING = "last training episodes"
_TASK = ("id", "kwargs", "parameters", "wrap", "max_episode_steps", "agents")
_MOST_SIZES = 3  # files and folders of a run, for a person
_TRACKERS = ("wandb",)  # folders that a tracker makes in a run


@dataclass(frozen=True, slots=True, kw_only=True)
class Score:
    """What a run has reached, to compare it with other runs of its task."""

    value: float
    of: str  # what it is the mean return of
    task: str  # only scores of one task and one kind are compared

    def __str__(self) -> str:
        return f"{short_number(self.value)} ({self.of})"


@dataclass(frozen=True, slots=True, kw_only=True)
class RunEntry:
    """A run of a folder, whether or not its files can be read."""

    directory: Path
    labels: Labels
    settings: Mapping[str, Any]  # by `section.key`; empty if they cannot be read
    run: RecordedRun | None  # None if it has no metrics yet, or cannot be read
    problem: str  # why it cannot be read; empty if it can
    made_by: str  # release of daedalus-rl; empty if it is not known
    written_by: str  # release that wrote its settings last
    size: int  # bytes that its removal would free
    is_running: bool

    @property
    def status(self) -> str:
        """How far the run is, in one word or two."""
        if self.is_running:
            return "running"
        if self.run is None:
            return "unreadable" if self.problem else "no metrics"
        if self.run.unfinished:
            return "not finished"
        return "solved" if self.run.summary.get("solved") else "finished"

    @property
    def score(self) -> Score | None:
        """What the run has reached. None: that or its task is unknown, or returns of self-play say nothing of it."""
        if self.run is None or not self.environment:
            return None
        task = self.task
        evaluation = self.run.summary.get("evaluation")
        matches = evaluation.get("matches") if isinstance(evaluation, dict) else None
        if isinstance(matches, dict):
            of = f"games against {bounded_text(str(matches.get('opponent')), 60)}"
        elif not all(map(math.isnan, self.run.metrics.get(RATING, ()))):
            return None
        else:
            of = "final evaluation"
        if self.run.evaluation_return is not None:
            return Score(value=self.run.evaluation_return, of=of, task=task)
        if not math.isfinite(self.run.training_return) or matches is not None:
            return None
        if not self.run.trains_true_task:
            shaping = [self.settings.get(f"environment.{name}") for name in ("training_kwargs", "no_reward_limit")]
            task += value_text([*shaping, self.run.lessons])
        return Score(value=self.run.training_return, of=_IN_TRAINING, task=task)

    @property
    def task(self) -> str:
        """What evaluations of the run play: the settings that tell its task from others."""
        return value_text([self.settings.get(f"environment.{name}") or None for name in _TASK])

    @property
    def is_evaluated(self) -> bool:
        """Whether the score is of an evaluation, and not of training."""
        return self.score is not None and self.score.of != _IN_TRAINING

    @property
    def env_steps(self) -> int:
        """Number of env_steps that the run has made."""
        return 0 if self.run is None else int(self.run.metrics[ENV_STEPS][-1])

    @property
    def environment(self) -> str:
        """The environment of the run; empty if it is not known."""
        return bounded_text(str(self.settings.get(ENVIRONMENT, "")), 100)


def read_entry(directory: Path) -> RunEntry:
    """Return what a run directory says, also of one that is damaged, or has nothing yet."""
    run, settings, labels, problems = None, dict[str, Any](), Labels(), list[str]()
    made_by = written_by = ""
    try:
        settings = read_run_settings(directory)
        with suppress(NoMetricsError):
            run = read_run(directory)
    except RunDataError as error:
        problems.append(str(error))
    try:
        labels = read_labels(directory)
        made_by, written_by = releases_of(directory)
    except (RunDataError, SettingsError) as error:
        problems.append(str(error))
    return RunEntry(
        directory=directory,
        labels=labels,
        settings=settings,
        run=run,
        problem="; ".join(dict.fromkeys(problems)),
        made_by=made_by,
        written_by=written_by,
        size=sum(sizes_of(directory).values()),
        is_running=is_locked(directory),
    )


def sizes_of(directory: Path) -> Counter[str]:
    """Return the bytes of each file and folder of a directory, by its name; of several names of one file, the first."""
    sizes, seen = Counter[str](), set[tuple[int, int]]()
    for folder, _, files in os.walk(directory):
        for name in files:
            path = Path(folder, name)
            try:
                found = path.lstat()
            except OSError:  # removed meanwhile
                continue
            if stat.S_ISREG(found.st_mode) and (found.st_dev, found.st_ino) not in seen:
                seen.add((found.st_dev, found.st_ino))
                sizes[path.relative_to(directory).parts[0]] += found.st_size
    return sizes


def best_runs(entries: Iterable[RunEntry], most: int = 1) -> list[RunEntry]:
    """Return the best runs of each task and kind of score, `most` of each; of equal ones those with fewer env_steps."""
    ranked: dict[tuple[str, str], list[RunEntry]] = {}
    scores = [(entry, score) for entry in entries if (score := entry.score) is not None]
    for entry, score in sorted(scores, key=lambda each: (-each[1].value, each[0].env_steps, each[0].directory)):
        ranked.setdefault((score.task, score.of), []).append(entry)
    return [entry for found in ranked.values() for entry in found[:most]]


@dataclass(frozen=True, slots=True)
class Verdict:
    """Whether a run is removed."""

    entry: RunEntry
    kept: str  # why it is kept; empty if it is removed


def prune_plan(entries: Sequence[RunEntry], *, best: int, unfinished: bool) -> list[Verdict]:
    """Return what happens to each run: all are removed but those that are in use, tagged, among the best, or unclear.

    Args:
      entries: the runs.
      best: how many of the best of each task are kept.
      unfinished: remove also runs that could be resumed, and those without a result.
    """
    done = [entry for entry in entries if entry.run is not None and not entry.run.unfinished]
    contests = [done, entries] if unfinished else [done]  # a run that is not finished displaces none that is
    kept_as_best = {entry.directory for contest in contests for entry in best_runs(contest, best)}
    verdicts = [
        Verdict(entry, _why_kept(entry, is_best=entry.directory in kept_as_best, unfinished=unfinished))
        for entry in entries
    ]
    needed = {path: verdict.entry.directory for verdict in verdicts if verdict.kept for path in _begins_with(verdict)}
    return [
        Verdict(verdict.entry, f"{needed[path]} begins with its weights")
        if not verdict.kept and (path := verdict.entry.directory.resolve()) in needed
        else verdict
        for verdict in verdicts
    ]


def _begins_with(verdict: Verdict) -> list[Path]:
    """Return the run from whose weights a kept run without a checkpoint would begin again, and what it is in."""
    if checkpoints(verdict.entry.directory):
        return []
    with suppress(RunDataError, ValueError):  # it may be no path
        recorded = (read_json(verdict.entry.directory / VERSIONS) or {}).get("init_from")
        if isinstance(recorded, str):
            initial = Path(os.path.realpath(recorded))
            return [initial, *initial.parents]
    return []


def _why_kept(entry: RunEntry, *, is_best: bool, unfinished: bool) -> str:
    if entry.is_running:
        return "it is running"
    if entry.directory.is_symlink():
        return "it is a link: name the directory itself"
    if entry.problem:
        return entry.problem
    if entry.labels.tags:
        return f"tagged {', '.join(entry.labels.tags)}"
    if is_best:
        return f"the best of {entry.environment}: {entry.score}"
    if not unfinished and (entry.run is None or entry.run.unfinished):
        return "it is not finished; --unfinished removes it"
    if not entry.environment:
        return "its environment is not known, so that nothing ranks it: remove it yourself"
    if entry.run is not None and not entry.run.unfinished and entry.score is None:
        return "its returns are of self-play, which rank nothing: remove it yourself"
    try:
        others = [name for name in parts_of(entry.directory)[1] if name not in _TRACKERS]
    except OSError as error:
        return f"it cannot be searched: {error.strerror}"
    return f"it has files that are not of a run, such as {bounded_text(others[0])}" if others else ""


def remove_run(directory: Path) -> None:
    """Remove a run that no process trains. Nobody sees a part of it.

    Raises RunInUseError, SettingsError, and RunDataError if a part cannot be removed; OSError if nothing can.
    """
    path = directory.resolve()  # of `.`, too
    aside = path.with_name(f".{path.name}.pruned")
    with lock_idle(directory) as lock:
        if read_labels(directory).tags:
            raise RunInUseError(f"{directory} has got a tag meanwhile")
        if sys.platform == "win32":  # an open file holds its folder
            lock.close()
        shutil.rmtree(aside, ignore_errors=True)
        path.rename(aside)
        try:
            shutil.rmtree(aside)
        except OSError as error:
            raise RunDataError(
                f"{directory} is removed in part: remove the rest, {aside}, yourself ({error.strerror})"
            ) from None


def remove_interrupted(folder: Path) -> None:
    """Remove what is left in a folder of runs whose removal was interrupted."""
    for aside in folder.glob(".*.pruned"):
        shutil.rmtree(aside, ignore_errors=True)


def described(entry: RunEntry) -> list[str]:
    """Return lines about a run for a person, without those about what it has not."""
    run, directory = entry.run, entry.directory
    spec = None if run is None else run.spec
    what = "" if spec is None else f": {entry.environment}, {spec.training.algorithm}, seed {spec.training.seed}"
    lines = [f"{directory}{what}; {entry.status}"]
    if entry.problem:
        lines.append(entry.problem)
    made = f"made by {entry.made_by or 'an unknown release'}"
    lines.append(made if entry.written_by == entry.made_by else f"{made}, continued by {entry.written_by}")
    if run is not None and spec is None:
        try:
            read_config(directory)
        except SettingsError as error:
            lines.append(str(error))
    if entry.labels.tags:
        lines.append(f"tags: {', '.join(entry.labels.tags)}")
    if entry.labels.note:
        lines.append(f"note: {entry.labels.note}")
    if entry.score is not None:
        lines.append(f"return {entry.score}, {entry.env_steps:,} env_steps")
    best = [*best_checkpoints(directory), *best_in_training(directory), *checkpoints(directory)][:1]
    newest = checkpoints(directory)[:1]
    lines.append(f"checkpoints: best {best[0].name}, newest {newest[0].name}" if newest and best else "no checkpoint")
    sizes = [f"{name} {size / 2**20:,.1f}" for name, size in sizes_of(directory).most_common(_MOST_SIZES)]
    lines.append(f"{entry.size / 2**20:,.1f} MiB, most of it in: {', '.join(sizes)}")
    if spec is not None and (modules := module_names(spec)):
        lines.append(f"needs the modules {', '.join(modules)}")
    if run is not None and spec is not None and best:
        lines.append(run.evaluate_command)
        lines.append(run.resume_command)
    return [line if not at else f"  {line}" for at, line in enumerate(lines)]
