"""Comparison of groups of runs: final return, env_steps and minutes to a threshold, improvement. Pure functions."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from daedalus.cli.comparing.grouping import Group
from daedalus.cli.comparing.recorded_run import ENVIRONMENT
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
    unnamed: Sequence[str] = ()  # settings in which the groups differ, and that are not in their names


def compare_groups(groups: Sequence[Group], threshold: float | None = None) -> Comparison:
    """Return the results of groups of runs.

    Args:
      groups: the groups, each with at least one run.
      threshold: mean return whose env_steps and minutes are compared (default: the target return, if all runs have one
        and it is the same).
    """
    runs = [run for group in groups for run in group.runs]
    targets = {run.target for run in runs}
    if threshold is None and len(targets) == 1:
        threshold = targets.pop()
    evaluated = all(run.evaluation is not None for run in runs)
    returns = [final_returns(group, evaluated=evaluated) for group in groups]
    results = []
    for index, group in enumerate(groups):
        env_steps = minutes = None
        if threshold is not None:
            env_steps, minutes = np.array([run.reached(threshold) for run in group.runs]).T
        results.append(
            GroupResult(
                group=group.name,
                runs=len(group.runs),
                final_return=estimate([returns[index]]),
                reached=None if env_steps is None else int(np.isfinite(env_steps).sum()),
                env_steps=None if env_steps is None else estimate([env_steps]),
                minutes=None if minutes is None else estimate([minutes]),
                improvement=improvement([returns[index]], [returns[0]]) if index else None,
            )
        )
    environment = next((run.settings[ENVIRONMENT] for run in runs if ENVIRONMENT in run.settings), "")
    return Comparison(
        environment=environment, evaluated=evaluated, threshold=threshold, results=results, unnamed=groups[0].unnamed
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
