"""Which runs a sweep makes, and in which order: all points of a grid, or points that Optuna chooses."""

import importlib
import itertools
import math
from collections import deque
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from daedalus.analysis.sweep_plan import Axis, Choices, PlannedRun, Planner, Point, point_name
from daedalus.learner.run.run_directory import SUMMARY, read_json, write_json
from daedalus.learner.run.settings import SettingsError

INSTALL = '--sampler needs Optuna, which is not installed: pip install "daedalus-rl[sweep]"'
TRIALS = "trials.json"


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

    The points are written to a file, so that an interrupted sweep goes on with the same ones. Optuna keeps nothing.
    """

    def __init__(
        self, planner: Planner, axes: Sequence[Axis], seeds: Sequence[int], *, trials: int, folder: Path
    ) -> None:
        """Read the points of an interrupted sweep, if there are any.

        Raises ModuleNotFoundError without Optuna, SettingsError if the file of points does not fit.
        """
        optuna = import_optuna()
        self._planner, self._axes, self._seeds, self._trials = planner, axes, seeds, trials
        self._file = folder / TRIALS
        self._points = self._read()
        self.planned: list[PlannedRun] = []
        self.total = max(trials, len(self._points)) * len(seeds)
        self._recorded = deque(enumerate(self._points))
        self._waiting: deque[PlannedRun] = deque()
        self._open: dict[int, _OpenTrial] = {}
        optuna.logging.set_verbosity(optuna.logging.WARNING)
        sampler = optuna.samplers.TPESampler(
            n_startup_trials=min(10, max(trials // 3, 1)),
            seed=seeds[0] + len(self._points),  # with the same seed, it would choose the first points again
        )
        self._study = optuna.create_study(direction="maximize", sampler=sampler)
        self._distributions = {axis.key: _distribution(axis) for axis in axes}

    def take(self) -> PlannedRun | None:
        """Return the next run, of a new point if that is its turn. See Search. Raises SettingsError, OSError."""
        if not self._waiting and not self._begin_trial():
            return None
        return self._waiting.popleft()

    def ended(self, run: PlannedRun, *, failed: bool) -> None:
        """Report the mean score of a point to Optuna after its last run. See Search."""
        number, trial = next((number, trial) for number, trial in self._open.items() if run in trial.runs)
        trial.scores.append(math.nan if failed else score(run))
        if len(trial.scores) < len(trial.runs):
            return
        del self._open[number]
        value = float(np.mean(trial.scores))
        if not math.isnan(value):
            self._tell(trial, value)

    def _begin_trial(self) -> bool:
        """Plan the runs of the next point, and return whether there is one."""
        asked = None
        if self._recorded:
            number, point = self._recorded.popleft()
        elif len(self._points) < self._trials:
            asked = self._study.ask(self._distributions)
            number, point = len(self._points), {axis.key: _written(axis, asked.params[axis.key]) for axis in self._axes}
            self._points.append(point)
            write_json(self._file, {"trials": self._points})
        else:
            return False
        runs = self._planner.runs(f"trial-{number + 1:03d}", point, self._seeds)
        self._open[number] = _OpenTrial(asked, point, runs)
        self._waiting += runs
        self.planned += runs
        return True

    def _tell(self, trial: "_OpenTrial", value: float) -> None:
        if trial.asked is not None:
            self._study.tell(trial.asked, value)
            return
        try:
            values = {axis.key: _read_value(axis, trial.point[axis.key]) for axis in self._axes}
            self._study.add_trial(
                import_optuna().trial.create_trial(params=values, distributions=self._distributions, value=value)
            )
        except ValueError:  # the command has other ranges than the one that chose this point
            return

    def _read(self) -> list[Point]:
        if not self._file.exists():
            return []
        points = read_json(self._file).get("trials")
        keys = {axis.key for axis in self._axes}
        if not isinstance(points, list) or not all(
            isinstance(point, dict) and point.keys() == keys for point in points
        ):
            raise SettingsError(
                f"{self._file} is damaged, or is of a sweep over other settings: choose another --folder"
            )
        return points


class _OpenTrial:
    """A point whose runs have not all ended."""

    def __init__(self, asked: Any | None, point: Point, runs: Sequence[PlannedRun]) -> None:
        self.asked, self.point, self.runs = asked, point, runs  # `asked` is None for a point of an interrupted sweep
        self.scores: list[float] = []


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
    trained = summary["episode_return_mean"] if run.spec.environment.trains_true_task else None
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


def _written(axis: Axis, value: Any) -> str:
    return value if isinstance(axis, Choices) else axis.written(value)


def _read_value(axis: Axis, text: str) -> Any:
    return text if isinstance(axis, Choices) else int(text) if axis.whole else float(text)
