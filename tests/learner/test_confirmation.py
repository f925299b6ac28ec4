"""learner/target_confirmation.py: the interval of a mean, and what the learner and the player say to each other."""

import math
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import numpy as np
import pytest
from plain import vector_spaces
from processes import LIMIT, until

from daedalus.learner.serving.run_context import RunContext
from daedalus.learner.serving.snapshot_publisher import SnapshotPublisher
from daedalus.learner.target_confirmation import Player, TargetConfirmation, confirmation, mean_interval
from daedalus.learner.training.checkpointer import Saving
from daedalus.protocol import keys
from daedalus.protocol.codec import decode, encode
from daedalus.protocol.limits import Limits
from daedalus.protocol.messages import (
    EvaluationReport,
    EvaluationRequest,
    Join,
    Message,
    Snapshot,
    Welcome,
)
from daedalus.protocol.spec import EnvironmentSpec, EvaluationSpec, RunSpec, TrainingSpec
from daedalus.transport.interface import TransportError
from daedalus.transport.memory import MemoryNetwork, MemoryTransport

if TYPE_CHECKING:
    from daedalus.learner.training.checkpointer import Checkpointer
    from daedalus.learner.training.learner import Learner

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
        density = np.cos(angles) ** (freedom - 1)
        integral = float(((density[1:] + density[:-1]) / 2 * np.diff(angles)).sum())
        assert constant * integral == pytest.approx(0.95, abs=1e-5)


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
    returns = np.random.default_rng(3).normal(460.0, 100.0, size=(1500, 100))
    results = [{"return_mean": each.mean(), "return_std": each.std(), "episodes": 100} for each in returns]
    odds = np.mean([[confirmation(result, target)["confirmed"] for target in (475.0, 460.0)] for result in results], 0)
    assert odds == pytest.approx([0.067, 0.5], abs=0.03)


@pytest.mark.parametrize(("target", "confirmed"), [(9.0, True), (10.0, True), (10.1, False), (11.9, False)])
def test_target_is_confirmed_if_the_mean_reaches_it(target: float, confirmed: bool) -> None:
    """The interval of 100 episodes of mean 10 and standard deviation 9.95 is 10 +- 1.984 x 9.95 / sqrt(99)."""
    result = confirmation({"return_mean": 10.0, "return_std": 9.95, "episodes": 100}, target)
    assert result["interval"] == pytest.approx((8.016, 11.984), abs=1e-3)
    assert result["confirmed"] is confirmed


class FakeLearner:
    """Learner with a policy version and one parameter."""

    policy_version = 1

    def weights(self) -> dict[str, np.ndarray]:
        return {"w": np.full(2, self.policy_version, np.float32)}


class FakeCheckpointer:
    """Checkpointer whose checkpoints are saved at once, unless the disk is full."""

    is_full = False

    def begin(self) -> Saving:
        return Saving(1, 1000, Path("checkpoints/1"))

    def wait(self, *_: object, **__: object) -> bool:
        return not self.is_full


Play = Callable[[Callable[[str, Any], Message]], object]  # is given a function that asks the learner


class Scene:
    """A learner that has reached its target of 475, and a player that does as the test says."""

    def __init__(self, directory: Path, play: Play) -> None:
        training = TrainingSpec(target_return=475.0, target_episodes=2, seed=7)
        evaluation = EvaluationSpec(episodes=2)
        spec = RunSpec(environment=EnvironmentSpec(id="A-v0"), training=training, evaluation=evaluation)
        self.context = RunContext.begin(directory, spec, threading.Event(), spaces=vector_spaces(2, 4))
        self.play, self.starts, self.failure, self.opened = play, True, "", 0
        publisher = SnapshotPublisher(self.context, MemoryTransport(MemoryNetwork()))
        publisher.offer_program(b"program")
        self.confirmation = TargetConfirmation(self.context, publisher, self._player, beat=lambda: None)
        self.learner, self.checkpointer = FakeLearner(), FakeCheckpointer()
        self.context.counters.returns.append(480.0)

    @contextmanager
    def _player(self) -> Iterator[Player]:
        self.opened += 1
        if not self.starts:
            raise TransportError("no display")
        network = MemoryNetwork()
        thread = threading.Thread(target=self._play, args=[MemoryTransport(network)])
        thread.start()
        try:
            yield Player(MemoryTransport(network), lambda: self.failure)
        finally:
            thread.join(LIMIT)

    def _play(self, transport: MemoryTransport) -> None:
        def ask(key: str, message: Any) -> Message:
            until(
                lambda: bool(transport.query(keys.join("*", "p"), encode(Join(actor="p", incarnation=1)), timeout=1.0))
            )
            timeout = 1.0 if isinstance(message, Join) else LIMIT
            (answer,) = transport.query(key, encode(message), timeout=timeout)
            return decode(answer, Limits())

        self.play(ask)

    def confirm(self) -> bool:
        return self.confirmation.confirm(cast("Learner", self.learner), cast("Checkpointer", self.checkpointer))

    @property
    def texts(self) -> list[str]:
        return [event.text for event in self.context.events.report() if event.kind == "target"]


def report(value: float, version: int = 1) -> EvaluationReport:
    returns, lengths = np.full(2, value), np.full(2, 9, np.int32)
    return EvaluationReport(
        evaluator="p", learner_epoch=1, policy_version=version, returns=returns, lengths=lengths, note="2 were cut"
    )


def test_learner_says_what_to_play_and_with_which_policy(tmp_path: Path) -> None:
    answers = list[Message]()

    def play(ask: Callable[[str, Any], Message]) -> None:
        key = keys.evaluations(scene.context.name, "p")
        answers.append(ask(keys.join("*", "p"), Join(actor="p", incarnation=1)))
        answers.append(ask(key, EvaluationRequest(evaluator="p")))
        answers.append(ask(key, report(475.0)))

    scene = Scene(tmp_path, play)
    assert scene.confirm()
    welcome, snapshot, _ = answers
    assert isinstance(welcome, Welcome)
    assert isinstance(snapshot, Snapshot)
    assert (welcome.play_episodes, welcome.play_seed, welcome.run) == (2, 7 + 2**34, scene.context.name)
    assert welcome.spec.evaluation.actions == "sampled"
    assert (snapshot.policy_version, snapshot.weights["w"].tolist()) == (1, [1.0, 1.0])
    result = scene.confirmation.result
    assert result is not None
    assert (result["confirmed"], result["return_mean"], result["length_mean"]) == (True, 475.0, 9.0)
    assert (result["policy_version"], result["seed"], result["notes"]) == (1, 7 + 2**34, ["2 were cut"])
    assert scene.texts == ["target 475 reached: the policy of this moment plays 2 new episodes to confirm it"]


def test_a_cloned_policy_has_the_first_evaluation_of_the_run(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    def play(ask: Callable[[str, Any], Message]) -> None:
        welcome = ask(keys.join("*", "p"), Join(actor="p", incarnation=1))
        assert isinstance(welcome, Welcome)
        assert (welcome.play_episodes, welcome.spec.evaluation.actions) == (2, "greedy")
        ask(keys.evaluations(scene.context.name, "p"), EvaluationRequest(evaluator="p"))
        ask(keys.evaluations(scene.context.name, "p"), report(30.0, version=0))

    scene = Scene(tmp_path, play)
    scene.learner.policy_version = 0
    caplog.set_level("INFO")
    scene.confirmation.evaluate_cloned(cast("Learner", scene.learner))
    assert "after behaviour cloning: return 30.0 +- 0 over 2 episodes, greedy" in caplog.text
    newest = scene.context.evaluations.take_newest()
    assert (newest["evaluation_return_mean"], newest["evaluation_env_steps"]) == (30.0, 0)
    scene.starts = False
    scene.confirmation.evaluate_cloned(cast("Learner", scene.learner))
    assert "the policy after behaviour cloning cannot be evaluated: no display" in caplog.text
    assert not scene.context.evaluations.take_newest()


def test_after_an_attempt_training_goes_on_for_as_long_as_it_took(tmp_path: Path) -> None:
    value = 470.0

    def play(ask: Callable[[str, Any], Message]) -> None:
        threading.Event().wait(0.3)
        ask(keys.evaluations(scene.context.name, "p"), EvaluationRequest(evaluator="p"))
        ask(keys.evaluations(scene.context.name, "p"), report(value))

    scene = Scene(tmp_path, play)
    assert not scene.confirm()
    assert not scene.context.counters.reached(475.0)
    for _ in range(100):  # as many updates at once
        assert not scene.confirm()
    assert scene.opened == 1
    (text,) = scene.texts[1:]
    assert text.startswith("not there yet: the new episodes have a mean return of 470.0. ")
    assert text.endswith("Training goes on, and tries again")
    value = 480.0
    until(scene.confirm)
    assert scene.confirmation.result is not None
    assert scene.confirmation.result["return_mean"] == 480.0


@pytest.mark.parametrize("how", ["says", "dies", "does not start"])
def test_target_counts_as_reached_if_the_episodes_cannot_be_played(tmp_path: Path, how: str) -> None:
    failed = Join(actor="p", incarnation=1, failure="no display")

    def play(ask: Callable[[str, Any], Message]) -> None:
        if how == "says":
            with suppress(ValueError):  # no answer
                ask(keys.join("*", "p"), failed)
        scene.failure = "no display"

    scene = Scene(tmp_path, play)

    scene.starts = how != "does not start"
    assert scene.confirm()
    assert scene.confirmation.result is None
    assert scene.texts[1:] == ["the target cannot be confirmed: no display"]


def test_target_counts_as_reached_if_nothing_can_be_saved(tmp_path: Path) -> None:
    scene = Scene(tmp_path, lambda _: None)
    scene.checkpointer.is_full = True
    assert scene.confirm()
    assert scene.opened == 0


def test_run_that_is_stopped_meanwhile_is_not_confirmed(tmp_path: Path) -> None:
    scene = Scene(tmp_path, lambda _: scene.context.stop.set())
    assert not scene.confirm()
    assert scene.confirmation.result is None
