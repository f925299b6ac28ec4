"""Test of analysis/statistics.py: slow oracles, cases worked by hand, and the coverage of the intervals."""

import itertools
import math
import statistics as standard

import numpy as np
import pytest

from daedalus.analysis.statistics import (
    improvement_interval,
    interquartile_interval,
    interquartile_mean,
    performance_profile,
    probability_of_improvement,
    profile_interval,
    stratified_bootstrap,
)


def strata(seed: int, *runs: int) -> list[np.ndarray]:
    random = np.random.default_rng(seed)
    return [random.integers(0, 6, count).astype(float) for count in runs]  # with ties


class TestInterquartileMean:
    def test_a_case_worked_by_hand(self) -> None:
        assert interquartile_mean(np.array([100.0, 1.0, 4.0, 2.0, 3.0])) == 3.0  # without 1 and 100
        assert interquartile_mean(np.array([9.0, 1.0, 2.0])) == 4.0  # a quarter of 3 is less than one run
        assert interquartile_mean(np.array([7.0])) == 7.0

    @pytest.mark.parametrize("runs", range(1, 14))
    def test_it_is_the_mean_of_the_middle_half(self, runs: int) -> None:
        scores = np.random.default_rng(runs).normal(size=runs)
        ordered = sorted(scores.tolist())
        for _ in range(math.floor(0.25 * runs)):
            ordered = ordered[1:-1]
        assert interquartile_mean(scores) == pytest.approx(standard.fmean(ordered))

    def test_each_column_is_a_score_of_its_own(self) -> None:
        scores = np.random.default_rng(0).normal(size=(8, 3))
        columns = [interquartile_mean(scores[:, column]) for column in range(3)]
        assert interquartile_mean(scores, 0) == pytest.approx(columns)

    def test_a_quarter_of_the_runs_may_never_reach_a_threshold(self) -> None:
        assert interquartile_mean(np.array([5.0, 7.0, 9.0, math.inf])) == 8.0
        assert interquartile_mean(np.array([5.0, 7.0, math.inf, math.inf])) == math.inf


class TestBootstrap:
    def test_the_interval_is_that_of_all_possible_samples(self) -> None:
        """With 3 and 2 runs there are 27 x 4 equally probable samples: their quantiles are the oracle."""
        first, second = np.array([1.0, 2.0, 10.0]), np.array([0.0, 5.0])
        means = sorted(
            standard.fmean([standard.fmean(x), standard.fmean(y)])
            for x in itertools.product(first, repeat=3)
            for y in itertools.product(second, repeat=2)
        )
        low, high = stratified_bootstrap(
            [first, second],
            lambda samples: np.mean([sample.mean(1) for sample in samples], axis=0),
            repetitions=50_000,
        )
        assert low == means[math.ceil(0.025 * len(means)) - 1]
        assert high == means[math.ceil(0.975 * len(means)) - 1]

    def test_tasks_are_resampled_alone(self) -> None:
        """Runs of one task always have the same score: samples that mixed the tasks would vary."""
        low, high = interquartile_interval([np.full(4, 1.0), np.full(4, 100.0)])
        assert low == high == 50.5

    def test_it_is_determined_by_its_seed(self) -> None:
        scores = strata(0, 8)
        assert interquartile_interval(scores, seed=1) == interquartile_interval(scores, seed=1)

    def test_one_run_has_no_interval(self) -> None:
        assert all(math.isnan(end) for end in interquartile_interval([np.array([3.0])]))
        assert all(math.isnan(end) for end in improvement_interval([np.array([3.0])], [np.array([1.0, 2.0])]))

    def test_runs_that_never_reach_a_threshold_make_an_end_infinite(self) -> None:
        low, high = interquartile_interval([np.array([5.0, 6.0, 7.0, math.inf, math.inf])])
        assert 5.0 <= low < 10.0
        assert high == math.inf

    @pytest.mark.parametrize(("runs", "least", "most"), [(3, 0.70, 0.80), (5, 0.88, 0.96), (30, 0.92, 0.98)])
    def test_it_contains_the_true_value_as_often_as_documented(self, runs: int, least: float, most: float) -> None:
        """The interquartile mean of a normal distribution is its mean."""
        random = np.random.default_rng(7)
        cases = 400
        contained = 0
        for case in range(cases):
            low, high = interquartile_interval([random.normal(3.0, 2.0, runs)], seed=case)
            contained += bool(low <= 3.0 <= high)
        assert least <= contained / cases <= most


class TestProfile:
    def test_a_case_worked_by_hand(self) -> None:
        scores = [np.array([1.0, 2.0, 3.0, 4.0]), np.array([2.0, 9.0])]
        profile = performance_profile(scores, np.array([0.0, 2.0, 4.0, 9.0]))
        assert profile.tolist() == [1.0, (0.5 + 0.5) / 2, (0.0 + 0.5) / 2, 0.0]
        assert np.isnan(performance_profile([np.array([1.0, np.nan])], np.array([0.0]))).all()

    def test_it_is_the_share_of_runs_above(self) -> None:
        scores, thresholds = strata(3, 7, 4, 5), np.linspace(-1.0, 7.0, 17)
        expected = [
            standard.fmean(sum(score > threshold for score in task) / len(task) for task in scores)
            for threshold in thresholds
        ]
        assert performance_profile(scores, thresholds) == pytest.approx(expected)
        low, high = profile_interval(scores, thresholds)
        assert np.all(low <= expected)
        assert np.all(expected <= high)
        assert low[0] == 1.0
        assert high[-1] == 0.0


class TestImprovement:
    def test_a_case_worked_by_hand(self) -> None:
        assert probability_of_improvement([np.array([2.0, 3.0])], [np.array([1.0, 2.0])]) == (1 + 0.5 + 1 + 1) / 4

    def test_it_is_the_share_of_pairs(self) -> None:
        first, second = strata(4, 5, 3), strata(5, 6, 2)
        tasks = []
        for x, y in zip(first, second, strict=True):
            pairs = [1.0 if a > b else 0.5 if a == b else 0.0 for a in x for b in y]
            tasks.append(standard.fmean(pairs))
        assert probability_of_improvement(first, second) == pytest.approx(standard.fmean(tasks))
        assert probability_of_improvement(second, first) == pytest.approx(1.0 - standard.fmean(tasks))

    def test_the_interval_separates_groups_that_do_not_overlap_and_no_others(self) -> None:
        random = np.random.default_rng(0)
        same, other = random.normal(size=10), random.normal(size=10)
        low, high = improvement_interval([same + 100.0], [other])
        assert (low, high) == (1.0, 1.0)
        low, high = improvement_interval([same], [other])
        assert low < 0.5 < high
