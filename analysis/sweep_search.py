"""Which runs a sweep makes, and in which order: all points of a grid, or points that Optuna chooses."""

import importlib
import itertools
import math
import os
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from daedalus.analysis.sweep_plan import Axis, Choices, PlannedRun, Planner, Range, point_name
from daedalus.learner.run.run_directory import SUMMARY, read_json
from daedalus.learner.run.run_files import read_file
from daedalus.learner.run.settings import SettingsError

INSTALL = '--sampler needs Optuna, which is not installed: pip install "daedalus-rl[analysis]"'
TRIALS = "trials.jsonl"
_MAX_TRIALS_BYTES = 64 << 20


def import_optuna() -> Any:
    """Return the module optuna, which is an extra. Raises ModuleNotFoundError."""
    return importlib.import_module("optuna")


class Search(Protocol):
    """Source of the runs of a sweep."""

    total: int  # number of runs
    planned: list[PlannedRun]  # the runs so far, in order

    def take(self) -> PlannedRun | None:
        """Return the next run, or None if there is none."""
        ...

    def ended(self, run: PlannedRun, *, failed: bool) -> None:
        """Take note of a run that has ended."""
        ...


class GridSearch:
    """Every combination of the values, first all with the first seed, so that an early end leaves a fair comparison."""

    def __init__(self, planner: Planner, axes: Sequence[Choices], seeds: Sequence[int]) -> None:
        """Plan all runs. Raises SettingsError if the settings of one are invalid."""
        points = [
            dict(zip((axis.key for axis in axes), values, strict=True))
            for values in itertools.product(*(axis.values for axis in axes))
        ]
        by_point = [planner.runs(point_name(point), point, seeds) for point in points]
        self.planned = [run for runs in zip(*by_point, strict=True) for run in runs]
        self.total = len(self.planned)
        self._next = iter(self.planned)

    def take(self) -> PlannedRun | None:
        """Return the next run. See Search."""
        return next(self._next, None)

    def ended(self, run: PlannedRun, *, failed: bool) -> None:
        """Do nothing: the grid does not depend on results."""


class SampledSearch:
    """Points that Optuna's TPE sampler chooses by the results so far.

    Optuna keeps them, with their scores, in a file of JSON lines, so that an interrupted sweep goes on with the same
    ones. It executes nothing that it reads there.
    """

    def __init__(
        self, planner: Planner, axes: Sequence[Axis], seeds: Sequence[int], *, trials: int, folder: Path
    ) -> None:
        """Read the points of an interrupted sweep, if there are any. The caller has locked the folder.

        Raises ModuleNotFoundError without Optuna, SettingsError and RunDataError if the file of points does not fit.
        """
        optuna = import_optuna()
        self._planner, self._seeds, self._trials = planner, seeds, trials
        self._distributions = {axis.key: _distribution(axis) for axis in axes}
        self._study = _study(optuna, folder)
        self._recorded = deque(self._usable(optuna, folder / TRIALS))
        self._begun = len(self._recorded)
        self._study.sampler = optuna.samplers.TPESampler(
            n_startup_trials=min(10, max(trials // 3, 1)),
            seed=seeds[0] + self._begun,  # with the same seed, it would choose the first points again
        )
        self.planned: list[PlannedRun] = []
        self.total = max(trials, self._begun) * len(seeds)
        self._waiting: deque[PlannedRun] = deque()
        self._open: list[_OpenTrial] = []

    def take(self) -> PlannedRun | None:
        """Return the next run, of a new point if that is its turn. See Search. Raises SettingsError, OSError."""
        if not self._waiting and not self._begin_trial():
            return None
        return self._waiting.popleft()

    def ended(self, run: PlannedRun, *, failed: bool) -> None:
        """Report the mean score of a point to Optuna after its last run, unless one failed. See Search."""
        trial = next(trial for trial in self._open if run in trial.runs)
        trial.scores.append(math.nan if failed else score(run))
        if len(trial.scores) < len(trial.runs):
            return
        self._open.remove(trial)
        value = float(np.mean(trial.scores))
        if not math.isnan(value):  # else the point stays open: the same command tries its failed runs again
            self._study.tell(trial.number, value, skip_if_finished=True)

    def _begin_trial(self) -> bool:
        """Plan the runs of the next point, and return whether there is one."""
        if self._recorded:
            trial = self._recorded.popleft()
        elif self._begun < self._trials:
            trial = self._study.ask(self._distributions)
            self._begun += 1
        else:
            return False
        point = {key: _written(trial.distributions[key], trial.params[key]) for key in self._distributions}
        runs = self._planner.runs(f"trial-{trial.number + 1:03d}", point, self._seeds)
        self._open.append(_OpenTrial(trial.number, runs))
        self._waiting += runs
        self.planned += runs
        return True

    def _usable(self, optuna: Any, file: Path) -> list[Any]:
        """Return the trials of earlier commands. Raises SettingsError if they are over other settings."""
        found = []
        for trial in self._study.trials:
            if trial.state == optuna.trial.TrialState.FAIL:
                continue
            if trial.distributions.keys() < self._distributions.keys():  # the command was killed as it chose the point
                self._study.tell(trial.number, state=optuna.trial.TrialState.FAIL)
                continue
            try:
                for key in {*trial.distributions, *self._distributions}:
                    before, now = trial.distributions[key], self._distributions[key]
                    optuna.distributions.check_distribution_compatibility(before, now)
            except (KeyError, ValueError):
                raise SettingsError(
                    f"{file} is of a sweep over other settings or other kinds of values: choose another --folder"
                ) from None
            found.append(trial)
        return found


@dataclass(slots=True, eq=False)
class _OpenTrial:
    """A point whose runs have not all ended."""

    number: int
    runs: Sequence[PlannedRun]
    scores: list[float] = field(default_factory=list)


class _LockedFolder:
    """Lock of the file of trials. The sweep holds a lock on its folder, which ends with the process."""

    def acquire(self) -> bool:
        """Do nothing: no other process writes the file."""
        return True

    def release(self) -> None:
        """Do nothing."""


def _study(optuna: Any, folder: Path) -> Any:
    """Return the study that is kept in a folder; a new one if there is none.

    Optuna reads JSON, and executes nothing. Raises SettingsError, RunDataError.
    """
    file, former = folder / TRIALS, folder / "trials.json"
    if former.exists():
        raise SettingsError(f"{former} is of a sweep of an older release, which cannot go on: choose another --folder")
    content = read_file(file, _MAX_TRIALS_BYTES)
    if content is not None:
        os.truncate(file, content.rfind(b"\n") + 1)  # without a line that a crash of the machine has cut
    optuna.logging.set_verbosity(optuna.logging.WARNING)
    try:
        backend = optuna.storages.journal.JournalFileBackend(str(file), lock_obj=_LockedFolder())
        storage = optuna.storages.JournalStorage(backend)
        return optuna.create_study(storage=storage, study_name="sweep", direction="maximize", load_if_exists=True)
    except Exception as error:  # Optuna promises none of its own for a damaged file
        raise SettingsError(f"{file} is damaged ({type(error).__name__}): choose another --folder") from None


def score(run: PlannedRun) -> float:
    """Return what a sampler maximises: the return of the final evaluation.

    Runs that stop at a target return are ranked by their env_steps instead, in shares of the budget: 1 - share. Those
    that miss the target rank below all of them, by the return of training, or that of the final evaluation where
    training plays another task.
    """
    summary = read_json(run.directory / SUMMARY)
    training = run.spec.training
    final = summary["evaluation_return_mean"]
    if training.target_return is None or not training.stop_when_solved:
        return final
    if summary["solved"]:
        return 1.0 - summary["env_steps"] / training.env_steps
    trained = summary["episode_return_mean"] if run.spec.trains_true_task else None
    mean = final if trained is None else trained
    return -max(training.target_return - mean, 0.0) / max(abs(training.target_return), 1.0)


def _distribution(axis: Axis) -> Any:
    """Return Optuna's description of an axis."""
    distributions = import_optuna().distributions
    if isinstance(axis, Choices):
        return distributions.CategoricalDistribution(axis.values)
    if axis.whole:
        return distributions.IntDistribution(int(axis.low), int(axis.high), log=axis.log)
    return distributions.FloatDistribution(axis.low, axis.high, log=axis.log)


def _written(distribution: Any, value: Any) -> str:
    """Return a value that Optuna chose, as it is written after `=`."""
    if isinstance(value, str):
        return value
    low, high, whole = distribution.low, distribution.high, isinstance(value, int)
    return Range(key="", low=low, high=high, whole=whole).written(value)
