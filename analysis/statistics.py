"""Statistics of a few runs: interquartile mean, bootstrap intervals, profiles, probability of improvement.

Agarwal et al. (2021), "Deep Reinforcement Learning at the Edge of the Statistical Precipice". Pure functions.

Scores are strata: one array for each task, whose first axis is the runs of that task. The runs of one task are one
stratum. A score may be infinite, such as the time to a threshold of a run that never reached it.
"""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

Strata = Sequence[np.ndarray]  # one array [runs of the task, ...] for each task
Statistic = Callable[[Sequence[np.ndarray]], np.ndarray]  # of strata with repetitions before the runs

_REPETITIONS = 2000
_CONFIDENCE = 0.95  # share of cases that an interval is to contain


class Interval(NamedTuple):
    """Confidence interval. Both ends are NaN if a task has a single run."""

    low: np.ndarray
    high: np.ndarray


def interquartile_mean(scores: np.ndarray, axis: int = -1) -> np.ndarray:
    """Return the mean of the middle half of the scores: a quarter of them, rounded down, is cut off at each end.

    Less sensitive to single runs than the mean, and less wasteful than the median. Agarwal et al. (2021), section 4.3.

    Args:
      scores: any shape; the mean with one that is unknown (NaN) is unknown.
      axis: axis of the runs.
    """
    runs = scores.shape[axis]
    cut = runs // 4
    middle = np.sort(scores, axis).take(np.arange(cut, runs - cut), axis)
    # The highest is NaN if one is: it would be cut off as the best run.
    return middle.mean(axis) + np.where(np.isnan(scores).any(axis), np.nan, 0.0)


def stratified_bootstrap(
    strata: Strata,
    statistic: Statistic,
    *,
    repetitions: int = _REPETITIONS,
    seed: int = 0,
) -> Interval:
    """Return the percentile interval of a statistic over bootstrap samples.

    Each bootstrap sample draws, for each task alone, as many runs with replacement as the task has. Agarwal et al.
    (2021), section 4.1. With 3 runs, a 95 % interval of the interquartile mean contains the true value in
    about 75 % of cases, with 4 in 87 %, with 5 to 10 in 90 to 94 %.

    Args:
      strata: the scores, [runs of the task, ...] for each task.
      statistic: maps resampled strata, [repetitions, runs of the task, ...], to values [repetitions, ...].
      repetitions: number of bootstrap samples.
      seed: of the samples.
    """
    random = np.random.default_rng(seed)
    samples = []
    for scores in strata:
        runs = len(scores)
        samples.append(scores[random.integers(runs, size=(repetitions, runs))])
    values = statistic(samples)
    if any(len(scores) < 2 for scores in strata):
        unknown = np.full(values.shape[1:], np.nan)
        return Interval(unknown, unknown)
    outside = (1.0 - _CONFIDENCE) / 2.0
    # Samples themselves, without interpolation: infinite scores have no values between them.
    low, high = np.quantile(values, [outside, 1.0 - outside], axis=0, method="inverted_cdf")
    return Interval(low, high)


def interquartile_interval(strata: Strata, *, seed: int = 0) -> Interval:
    """Return the interval of the interquartile mean of the runs of all tasks together. See stratified_bootstrap."""
    return stratified_bootstrap(strata, lambda samples: interquartile_mean(np.concatenate(samples, 1), 1), seed=seed)


def performance_profile(strata: Strata, thresholds: np.ndarray) -> np.ndarray:
    """Return the share of runs with a score above each threshold, as the mean over the tasks.

        F(tau) = 1/M sum_m 1/N_m sum_n [x_mn > tau]

    Agarwal et al. (2021), section 4.2.

    Args:
      strata: the scores, [runs of the task] for each task; the profile with one that is unknown (NaN) is unknown.
      thresholds: [thresholds].

    Returns: [thresholds].
    """
    return _shares_above([scores[None] for scores in strata], thresholds)[0]


def profile_interval(strata: Strata, thresholds: np.ndarray) -> Interval:
    """Return the pointwise interval of a performance profile, [thresholds]. See stratified_bootstrap."""
    return stratified_bootstrap(strata, lambda samples: _shares_above(samples, thresholds))


def _shares_above(samples: Strata, thresholds: np.ndarray) -> np.ndarray:
    """Return [repetitions, thresholds] from strata [repetitions, runs of the task]."""
    tasks = [_above(scores[:, :, None], thresholds).mean(1) for scores in samples]
    return np.mean(tasks, axis=0)


def _above(scores: np.ndarray, thresholds: np.ndarray) -> np.ndarray:
    return np.where(np.isnan(scores), np.nan, scores > thresholds)


def probability_of_improvement(first: Strata, second: Strata) -> float:
    """Return the probability that a run of `first` has a higher score than one of `second`, a tie counting half.

        P(X > Y) = 1/M sum_m 1/(N_m K_m) sum_i sum_j S(x_mi, y_mj),  S = 1 if x > y, 1/2 if x = y, else 0

    The Mann-Whitney statistic of each task, as the mean over the tasks. Agarwal et al. (2021), section 4.3.

    Args:
      first, second: scores of two algorithms on the same tasks.
    """
    return float(_improvements([*(x[None] for x in first), *(y[None] for y in second)])[0])


def improvement_interval(first: Strata, second: Strata) -> Interval:
    """Return the interval of the probability of improvement; the runs of both are resampled."""
    return stratified_bootstrap([*first, *second], _improvements)


def _improvements(samples: Strata) -> np.ndarray:
    """Return [repetitions] from strata [repetitions, runs]: the tasks of one algorithm, then those of the other."""
    tasks = len(samples) // 2
    pairs = zip(samples[:tasks], samples[tasks:], strict=True)
    return np.mean([_better(x[:, :, None], y[:, None, :]).mean((1, 2)) for x, y in pairs], axis=0)


def _better(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    return np.where(np.isnan(x) | np.isnan(y), np.nan, (x > y) + 0.5 * (x == y))
