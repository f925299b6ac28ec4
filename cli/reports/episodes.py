"""Statistics of the episodes of one evaluation. Pure functions."""

import math
from dataclasses import dataclass

import numpy as np

from daedalus.cli.comparing.comparison import Estimate
from daedalus.cli.comparing.statistics import interquartile_mean, stratified_bootstrap
from daedalus.cli.reports.run_record import RecordedEvaluation
from daedalus.launch.confirmation import mean_interval

_REPETITIONS = 2000
_MOST_VALUES = 4_000_000  # that the bootstrap draws in all, to limit its memory and its time


@dataclass(frozen=True, slots=True, kw_only=True)
class EpisodeStatistics:
    """Statistics of the returns of one policy's episodes. The intervals are of 95 % and are about this policy alone."""

    mean: Estimate  # NaN: unknown, as for a single episode
    std: float
    interquartile: Estimate | None  # None without the returns of the episodes, as the median
    median: float | None


def episode_statistics(evaluation: RecordedEvaluation) -> EpisodeStatistics:
    """Return the statistics of an evaluation."""
    interval = mean_interval(evaluation.return_mean, evaluation.return_std, evaluation.episodes)
    returns = np.array(evaluation.returns)
    return EpisodeStatistics(
        mean=Estimate(evaluation.return_mean, *(interval or (math.nan, math.nan))),
        std=evaluation.return_std,
        interquartile=_interquartile(returns) if len(returns) else None,
        median=float(np.median(returns)) if len(returns) else None,
    )


def _interquartile(returns: np.ndarray) -> Estimate:
    """Return the interquartile mean of returns, [episodes], with its bootstrap interval."""
    value = float(interquartile_mean(returns))
    repetitions = min(_MOST_VALUES // len(returns), _REPETITIONS)
    if repetitions < _REPETITIONS // 10:
        return Estimate(value, math.nan, math.nan)
    low, high = stratified_bootstrap([returns], lambda samples: interquartile_mean(samples[0]), repetitions=repetitions)
    return Estimate(value, float(low), float(high))
