"""cli/confirmation.py: the interval of a mean, and episodes that nothing else of a run plays."""

import numpy as np
import pytest

from daedalus.cli.commands.evaluate_arguments import parser
from daedalus.cli.confirmation import confirmation, confirmation_arguments, mean_interval
from daedalus.protocol.spec import EnvironmentSpec, EvaluationSpec, RunSpec, TrainingSpec

# 97.5 % quantiles of Student's distribution by degrees of freedom, from tables.
QUANTILES = {1: 12.706, 2: 4.303, 3: 3.182, 4: 2.776, 9: 2.262, 30: 2.042, 99: 1.984, 9999: 1.960}


@pytest.mark.parametrize(("freedom", "quantile"), QUANTILES.items())
def test_interval_is_that_of_students_distribution(freedom: int, quantile: float) -> None:
    values = np.random.default_rng(1).normal(size=freedom + 1)
    expected = quantile * values.std(ddof=1) / (freedom + 1) ** 0.5
    interval = mean_interval(10.0, float(values.std()), freedom + 1)
    assert interval is not None
    assert interval == pytest.approx((10.0 - expected, 10.0 + expected), rel=0.005)


def test_interval_contains_the_mean_of_the_distribution_in_95_of_100_cases() -> None:
    random = np.random.default_rng(2)
    contained = 0
    for _ in range(2000):
        values = random.exponential(3.0, size=100)
        low, high = mean_interval(float(values.mean()), float(values.std()), 100) or (0.0, 0.0)
        contained += low <= 3.0 <= high
    assert 0.93 < contained / 2000 < 0.96  # a little less than 0.95, because the distribution is skewed


def test_single_episode_has_no_interval() -> None:
    assert confirmation({"return_mean": 3.0, "return_std": 0.0, "episodes": 1})["interval"] is None


def test_confirmation_plays_the_newest_policy_as_in_training() -> None:
    spec = RunSpec(
        environment=EnvironmentSpec(id="A-v0", backend="envpool"),
        training=TrainingSpec(seed=7, target_episodes=50),
        evaluation=EvaluationSpec(final_backend="gymnasium"),
    )
    parsed = parser().parse_args(["run", *confirmation_arguments(spec)])
    assert (parsed.newest, parsed.actions, parsed.backend, parsed.episodes) == (True, "sampled", "envpool", 50)
    assert parsed.seed not in (7, 7 + 2**32, 7 + 2**33)  # training, the final evaluation, the selection
