"""cli/confirmation.py: the interval of a mean, and episodes that nothing else of a run plays."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from daedalus.cli.child_output import ChildOutput
from daedalus.cli.commands.evaluate_arguments import parser
from daedalus.cli.comparing.statistics import mean_interval
from daedalus.cli.running import confirmation as module
from daedalus.cli.running.confirmation import Confirmations, confirmation, confirmation_arguments
from daedalus.learner.run.confirmation_file import ConfirmationFile
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


@pytest.mark.parametrize(("mean", "target", "confirmed"), [(3.0, 3.0, True), (3.0, 3.1, False)])
def test_single_episode_has_no_interval_and_decides_alone(mean: float, target: float, confirmed: bool) -> None:
    result = confirmation({"return_mean": mean, "return_std": 0.0, "episodes": 1}, target)
    assert (result["interval"], result["confirmed"]) == (None, confirmed)


@pytest.mark.parametrize(("target", "confirmed"), [(9.0, True), (11.9, True), (12.1, False), (50.0, False)])
def test_target_is_not_confirmed_if_the_whole_interval_is_below_it(target: float, confirmed: bool) -> None:
    """The interval of 100 episodes of mean 10 and standard deviation 9.95 is 10 +- 1.984 x 9.95 / sqrt(99)."""
    result = confirmation({"return_mean": 10.0, "return_std": 9.95, "episodes": 100}, target)
    assert result["interval"] == pytest.approx((8.016, 11.984), abs=1e-3)
    assert result["confirmed"] is confirmed


def test_confirmation_plays_as_in_training() -> None:
    spec = RunSpec(
        environment=EnvironmentSpec(id="A-v0", backend="envpool"),
        training=TrainingSpec(seed=7, target_episodes=50),
        evaluation=EvaluationSpec(final_backend="gymnasium"),
    )
    parsed = parser().parse_args(["run", *confirmation_arguments(spec)])
    assert (parsed.actions, parsed.backend, parsed.episodes) == ("sampled", "envpool", 50)
    assert parsed.seed not in (7, 7 + 2**32, 7 + 2**33)  # training, the final evaluation, the selection


class InstantProcess:
    """`daedalus evaluate` that has ended as soon as it is started."""

    started: list[Path]

    def __init__(self, arguments: list[str], *_: Any, **__: Any) -> None:
        self._checkpoint = parser().parse_args(arguments).directory
        self.started.append(self._checkpoint)

    def has_ended(self) -> bool:
        return True

    def result(self) -> dict[str, Any]:
        return {"policy_version": int(self._checkpoint.name), "return_mean": 9.0, "return_std": 0.0, "episodes": 2}

    def close(self) -> None:
        pass


@pytest.fixture
def confirmations(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Confirmations]:
    monkeypatch.setattr(InstantProcess, "started", [], raising=False)
    monkeypatch.setattr(module, "EvaluationProcess", InstantProcess)
    spec = RunSpec(environment=EnvironmentSpec(id="A-v0"), training=TrainingSpec(target_return=5.0))
    ConfirmationFile(tmp_path).ask(3)  # of a launcher that was killed
    with ChildOutput(tmp_path / "output.log", print, print) as output:
        yield Confirmations(tmp_path, spec, [], output)


def test_confirmation_plays_the_checkpoint_that_the_learner_asks_for(
    tmp_path: Path, confirmations: Confirmations
) -> None:
    """The newest checkpoint may be another: a damaged one of a higher version that could not be renamed."""
    file = ConfirmationFile(tmp_path)
    confirmations.poll()
    file.ask(450)
    confirmations.poll()
    confirmations.poll()
    assert InstantProcess.started == [tmp_path / "checkpoints" / "0000000450"]
    answered = file.answered(450)
    assert answered is not None
    assert answered["confirmed"] is True


def test_learner_that_asks_again_gets_the_result_of_the_version_that_it_asks_for_then(
    tmp_path: Path, confirmations: Confirmations
) -> None:
    file = ConfirmationFile(tmp_path)
    file.ask(450)
    confirmations.poll()
    file.ask(451)  # by a learner that was restarted
    confirmations.poll()
    assert file.answered(450) is file.answered(451) is None
    confirmations.poll()
    confirmations.poll()
    assert [each.name for each in InstantProcess.started] == ["0000000450", "0000000451"]
    assert file.answered(451) is not None
