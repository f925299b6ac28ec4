"""cli/confirmation.py: the interval of a mean, and episodes that nothing else of a run plays."""

import math
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import numpy as np
import pytest
from processes import until

from daedalus.cli.commands.evaluate import parser
from daedalus.launch import confirmation as module
from daedalus.launch.child_output import ChildOutput
from daedalus.launch.confirmation import Confirmations, confirmation, confirmation_arguments, mean_interval
from daedalus.learner.run.confirmation_file import ConfirmationFile
from daedalus.learner.serving.run_context import RunContext
from daedalus.learner.target_confirmation import TargetConfirmation
from daedalus.protocol.spec import EnvironmentSpec, EvaluationSpec, RunSpec, TrainingSpec

if TYPE_CHECKING:
    from daedalus.learner.training.checkpointer import Checkpointer

# 97.5 % quantiles of Student's distribution by degrees of freedom, from tables.
QUANTILES = {1: 12.7062, 2: 4.3027, 3: 3.1824, 4: 2.7764, 5: 2.5706, 6: 2.4469, 7: 2.3646, 8: 2.3060, 9: 2.2622}
QUANTILES |= {10: 2.2281, 15: 2.1314, 20: 2.0860, 30: 2.0423, 60: 2.0003, 99: 1.9842, 200: 1.9719, 9999: 1.9602}


@pytest.mark.parametrize(("freedom", "quantile"), QUANTILES.items())
def test_interval_is_that_of_students_distribution(freedom: int, quantile: float) -> None:
    values = np.random.default_rng(1).normal(size=freedom + 1)
    values /= values.std(ddof=1) / (freedom + 1) ** 0.5
    expected = quantile
    interval = mean_interval(10.0, float(values.std()), freedom + 1)
    assert interval is not None
    assert interval == pytest.approx((10.0 - expected, 10.0 + expected), abs=1e-4)


def test_interval_holds_95_percent_of_students_density_for_each_number_of_episodes() -> None:
    for freedom in range(1, 260):
        _, quantile = mean_interval(0.0, freedom**0.5, freedom + 1) or (0.0, 0.0)
        angles = np.linspace(0.0, np.arctan(quantile / freedom**0.5), 2001)  # t = sqrt(freedom) tan(angle)
        constant = 2 * math.exp(math.lgamma((freedom + 1) / 2) - math.lgamma(freedom / 2)) / math.pi**0.5
        assert constant * np.trapezoid(np.cos(angles) ** (freedom - 1), angles) == pytest.approx(0.95, abs=1e-5)


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


def test_a_policy_below_the_target_is_rarely_confirmed() -> None:
    """True mean 460, target 475, standard error 10: 1.5 standard errors. The interval's upper end confirmed 69 %."""
    returns = np.random.default_rng(3).normal(460.0, 100.0, size=(4000, 100))
    results = [{"return_mean": each.mean(), "return_std": each.std(), "episodes": 100} for each in returns]
    odds = np.mean([[confirmation(result, target)["confirmed"] for target in (475.0, 460.0)] for result in results], 0)
    assert odds == pytest.approx([0.067, 0.5], abs=0.02)


@pytest.mark.parametrize(("target", "confirmed"), [(9.0, True), (10.0, True), (10.1, False), (11.9, False)])
def test_target_is_confirmed_if_the_mean_reaches_it(target: float, confirmed: bool) -> None:
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


class Saved:
    """A checkpointer whose checkpoints are saved at once."""

    def begin(self) -> None: ...

    def wait(self, *_: object, **__: object) -> bool:
        return True


def test_after_an_attempt_training_goes_on_for_as_long_as_it_took(tmp_path: Path) -> None:
    spec = RunSpec(
        environment=EnvironmentSpec(id="A-v0"), training=TrainingSpec(target_return=475.0, target_episodes=1)
    )
    state, stop = RunContext.begin(tmp_path, spec, threading.Event()), threading.Event()
    learner = TargetConfirmation(state, beat=lambda: None)
    file, checkpointer = ConfirmationFile(tmp_path), cast("Checkpointer", Saved())

    def launch() -> None:
        while not stop.wait(0.3):
            if (version := file.asked()) is not None:
                result = {"return_mean": 480.0 if version == 3 else 470.0, "return_std": 0.0, "episodes": 1}
                file.answer(version, confirmation(result, 475.0))

    launcher = threading.Thread(target=launch)
    launcher.start()
    try:
        state.counters.returns.append(480.0)
        assert not learner.confirm(1, checkpointer)
        assert not state.counters.reached(475.0)
        for _ in range(100):  # as many updates at once
            assert not learner.confirm(2, checkpointer)
        assert [event.text for event in state.events.report() if event.kind == "target"] == [
            "target 475 reached: the policy of this moment plays 1 new episodes to confirm it",
            "not confirmed: return 470.0; training continues",
        ]
        until(lambda: learner.confirm(3, checkpointer))
    finally:
        stop.set()
        launcher.join()
    assert learner.result is not None
    assert learner.result["return_mean"] == 480.0
