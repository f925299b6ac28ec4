"""Comparison of groups of runs: final return, env_steps and minutes to a threshold, improvement. Pure functions."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from daedalus.cli.comparing.grouping import Group, text
from daedalus.cli.comparing.recorded_run import ENVIRONMENT, record_command
from daedalus.cli.comparing.statistics import (
    Strata,
    improvement_interval,
    interquartile_interval,
    interquartile_mean,
    probability_of_improvement,
)


class Estimate(NamedTuple):
    """A statistic and its 95 % interval; infinite: the threshold was not reached; NaN: unknown."""

    value: float
    low: float
    high: float


@dataclass(frozen=True, slots=True, kw_only=True)
class GroupResult:
    """Results of a group."""

    group: str
    runs: int
    final_return: Estimate  # interquartile mean, as the following two
    reached: int | None  # number of runs that reached the threshold; None without a threshold, as the following two
    env_steps: Estimate | None
    minutes: Estimate | None
    improvement: Estimate | None  # probability of a higher final return than the first group; None for that group


@dataclass(frozen=True, slots=True, kw_only=True)
class Comparison:
    """Results of all groups."""

    environment: str
    evaluated: bool  # whether the final return is that of the final evaluation, and not of the last training episodes
    threshold: float | None
    results: Sequence[GroupResult]
    other_task: bool = False  # whether a run trains on another task than that of evaluations
    incomparable: str = ""  # why the final returns are not compared
    unnamed: Sequence[str] = ()  # settings in which the groups differ, and that are not in their names


def compare_groups(groups: Sequence[Group], threshold: float | None = None) -> Comparison:
    """Return the results of groups of runs.

    Args:
      groups: the groups, each with at least one run.
      threshold: mean return whose env_steps and minutes are compared (default: the target return, if all runs have one
        and it is the same). If a run trains on another task than that of evaluations, evaluations have to reach it.
    """
    runs = [run for group in groups for run in group.runs]
    targets = {run.target for run in runs}
    if threshold is None and len(targets) == 1:
        threshold = targets.pop()
    evaluated = all(run.evaluation is not None for run in runs)
    other_task = not all(run.trains_true_task for run in runs)
    returns = [final_returns(group, evaluated=evaluated) for group in groups]
    if problem := incomparable_returns(groups):
        returns = [np.full(len(values), np.nan) for values in returns]
    results = []
    for index, group in enumerate(groups):
        env_steps = minutes = None
        if threshold is not None:
            env_steps, minutes = np.array([run.reached(threshold, evaluated=other_task) for run in group.runs]).T
            if np.isnan(env_steps).any():
                env_steps, minutes = np.full_like(env_steps, np.nan), np.full_like(minutes, np.nan)
        results.append(
            GroupResult(
                group=group.name,
                runs=len(group.runs),
                final_return=estimate([returns[index]]),
                reached=None if env_steps is None else _finite(env_steps),
                env_steps=None if env_steps is None else estimate([env_steps]),
                minutes=None if minutes is None else estimate([minutes]),
                improvement=improvement([returns[index]], [returns[0]]) if index else None,
            )
        )
    environment = next((run.settings[ENVIRONMENT] for run in runs if ENVIRONMENT in run.settings), "")
    return Comparison(
        environment=environment,
        evaluated=evaluated,
        threshold=threshold,
        results=results,
        unnamed=groups[0].unnamed,
        other_task=other_task,
        incomparable=problem,
    )


def _finite(env_steps: np.ndarray) -> int | None:
    """Return how many runs reached a threshold, or None if it is not known of all."""
    return None if np.isnan(env_steps).any() else int(np.isfinite(env_steps).sum())


def training_tasks(groups: Sequence[Group]) -> set[str]:
    """Return what makes the tasks that the runs train on differ from those of their evaluations, as texts."""
    played = [run.environment for group in groups for run in group.runs if run.environment is not None]
    return {"" if task.trains_true_task else text([task.training_kwargs, task.no_reward_limit]) for task in played}


def incomparable_returns(groups: Sequence[Group]) -> str:
    """Return why final returns cannot be compared: some are of training, on different tasks. Else an empty string."""
    runs = [run for group in groups for run in group.runs]
    without = [run for run in runs if run.evaluation is None]
    if not without or len(training_tasks(groups)) < 2:
        return ""
    return (
        "final returns cannot be compared: training plays different tasks (environment.training_kwargs or "
        "environment.no_reward_limit) and not all runs were evaluated; evaluate them, such as with: "
        f"{record_command(without[0].directory)}"
    )


def final_returns(group: Group, *, evaluated: bool) -> np.ndarray:
    """Return the final return of each run, [runs]: of its final evaluation, or of its last training episodes."""
    values = [run.evaluation if evaluated else run.training_return for run in group.runs]
    return np.array([math.nan if value is None else value for value in values])


def estimate(strata: Strata) -> Estimate:
    """Return the interquartile mean of the runs of all tasks, with its interval."""
    interval = interquartile_interval(strata)
    mean = interquartile_mean(np.concatenate(strata))
    return Estimate(float(mean), float(interval.low), float(interval.high))


def improvement(strata: Strata, first: Strata) -> Estimate:
    """Return the probability that a run has a higher score than one of `first`, with its interval."""
    interval = improvement_interval(strata, first)
    return Estimate(probability_of_improvement(strata, first), float(interval.low), float(interval.high))
