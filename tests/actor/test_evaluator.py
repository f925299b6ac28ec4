"""Evaluator against a scripted learner, over the memory transport."""

import contextlib
import queue
import threading
from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from allowed_modules import TEST_MODULES
from log_lines import LINES
from plain import NAME, vector_spaces
from processes import LIMIT

from daedalus.actor.environments.vector_environments import Observed, Step
from daedalus.actor.errors import ActorError
from daedalus.actor.evaluation.evaluator import Evaluator
from daedalus.actor.session.actor_config import ActorConfig, own_origin
from daedalus.policy.acting.program import export_program
from daedalus.policy.network.actor_critic import ActorCritic
from daedalus.protocol import keys
from daedalus.protocol.codec import decode, encode
from daedalus.protocol.limits import Limits
from daedalus.protocol.messages import (
    Acknowledgement,
    EvaluationReport,
    EvaluationRequest,
    Join,
    Message,
    Program,
    Refusal,
    Snapshot,
    Welcome,
    program_hash,
)
from daedalus.protocol.spec import PolicySpec, RunSpec
from daedalus.transport.interface import Request
from daedalus.transport.memory import MemoryNetwork, MemoryTransport


def run_spec(seconds: float = 0.001, episodes: int = 2, **environment: Any) -> RunSpec:
    return RunSpec.model_validate(
        {
            "environment": {"id": "counting_environment:Counting-v0", **environment},
            "evaluation": {"seconds": seconds, "episodes": episodes},
        }
    )


SPACES = vector_spaces(2, 4)
NETWORK = ActorCritic(PolicySpec(hidden=()), SPACES)
MODEL = export_program(NETWORK, SPACES)


class ScriptedLearner:
    """A learner that welcomes evaluators and has a program; the test answers their requests and reports."""

    def __init__(self, network: MemoryNetwork, spec: RunSpec, epoch: int = 1) -> None:
        self.transport = MemoryTransport(network)
        self.epoch, self.spec = epoch, spec
        self.play_episodes, self.play_seed = 0, 0
        self.joins: queue.Queue[Join] = queue.Queue()
        self.received: queue.Queue[Request] = queue.Queue()
        self.present: list[str] = []
        self.transport.serve(keys.evaluations("r", "*"), self.received.put)
        self.transport.serve(keys.program("r", "*"), self._program)
        self.transport.watch_presence(keys.presence("r", "*", "*"), lambda key, _: self.present.append(key))
        self.transport.serve(keys.join("r", "*"), self.answer_join)

    def answer_join(self, request: Request) -> None:
        message = decode(request.payload, Limits())
        assert isinstance(message, Join)
        self.joins.put(message)
        welcome = Welcome(
            run="r",
            learner_epoch=self.epoch,
            seed=1,
            spec=self.spec.for_actors(),
            play_episodes=self.play_episodes,
            play_seed=self.play_seed,
        )
        request.reply(encode(welcome))

    def _program(self, request: Request) -> None:
        request.reply(encode(Program.of(MODEL)))

    def snapshot(self, version: int, action: int = 0, epoch: int | None = None) -> Snapshot:
        """A policy whose most probable action is always the same; other actions are possible too."""
        weights = {name: np.zeros(tuple(value.shape), np.float32) for name, value in NETWORK.named_parameters()}
        weights["policy_head.bias"][action] = 1.0
        return Snapshot(
            learner_epoch=self.epoch if epoch is None else epoch,
            policy_version=version,
            program=program_hash(MODEL),
            weights=weights,
        )

    def receive(self) -> tuple[Message, Request]:
        request = self.received.get(timeout=LIMIT)
        assert request.key == keys.evaluations("r", "e")
        return decode(request.payload, Limits()), request

    def give(self, message: Message) -> None:
        """Answer the next request for a policy."""
        asked, request = self.receive()
        assert asked == EvaluationRequest(evaluator="e")
        request.reply(encode(message))

    def receive_report(self, verdict: Any = "accepted", reason: str = "") -> EvaluationReport:
        report, request = self.receive()
        assert isinstance(report, EvaluationReport)
        request.reply(encode(Acknowledgement(verdict=verdict, reason=reason)))
        return report


class RunningEvaluator:
    def __init__(self, network: MemoryNetwork, timeout: float | None = None) -> None:
        self.stop = threading.Event()
        self.error: Exception | None = None
        self.finished = False  # whether the evaluator has left because the run is over, or all is played
        config = ActorConfig(name="e", incarnation=7, timeout=timeout, modules=TEST_MODULES)
        self._evaluator = Evaluator(config, MemoryTransport(network), self.stop)
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def _run(self) -> None:
        try:
            self.finished = self._evaluator.run()
        except Exception as error:
            self.error = error

    def join(self) -> None:
        """Wait for the evaluator's end; no learner has to answer it."""
        self._thread.join(LIMIT)
        assert not self._thread.is_alive()

    def end(self, learner: ScriptedLearner) -> None:
        """Stop the evaluator, and answer what it may just have asked the learner."""
        self.stop.set()
        learner.transport.close()
        while self._thread.is_alive():
            with contextlib.suppress(queue.Empty):
                learner.received.get(timeout=0.01).reply(encode(Refusal(code="finished", reason="")))


JOIN = Join(actor="e", incarnation=7, origin=own_origin(MemoryTransport(MemoryNetwork())))


@pytest.fixture
def learner(network: MemoryNetwork) -> ScriptedLearner:
    return ScriptedLearner(network, run_spec())


@pytest.fixture
def evaluator(network: MemoryNetwork, learner: ScriptedLearner) -> Iterator[RunningEvaluator]:
    running = RunningEvaluator(network)
    yield running
    running.end(learner)


def test_evaluator_plays_greedily_and_reports(learner: ScriptedLearner, evaluator: RunningEvaluator) -> None:
    learner.give(learner.snapshot(version=5, action=3))
    report = learner.receive_report()
    assert (report.evaluator, report.learner_epoch, report.policy_version) == ("e", 1, 5)
    # Two environments play their first episode: rewards 0, 1 and 2, plus 0.3 for the action at each step.
    np.testing.assert_allclose(report.returns, [3.9, 3.9], rtol=1e-6)
    assert report.lengths.tolist() == [3, 3]


def test_evaluator_samples_if_the_run_says_so(network: MemoryNetwork) -> None:
    """The greedy action is always 0; samples are nearly always 0."""
    spec = run_spec()
    sampling = spec.model_copy(update={"evaluation": spec.evaluation.model_copy(update={"actions": "sampled"})})
    learner = ScriptedLearner(network, sampling)
    evaluator = RunningEvaluator(network)
    seen = set()
    try:
        for version in range(8):
            learner.give(learner.snapshot(version))
            report = learner.receive_report()
            seen |= set(((report.returns * 10).round() % 10).tolist())
    finally:
        evaluator.end(learner)
    assert seen - {0.0}


def test_episodes_are_played_at_once_with_each_policy_until_none_is_left(network: MemoryNetwork) -> None:
    """Equal seeds give equal episodes. The policy of version 4 always takes action 1, so its results differ."""
    returns = []
    for seed in (2**34 + 1, 2**34 + 1, 5):
        spec = run_spec(seconds=1000.0)
        spec = spec.model_copy(update={"evaluation": spec.evaluation.model_copy(update={"actions": "sampled"})})
        learner = ScriptedLearner(network, spec)
        learner.play_episodes, learner.play_seed = 40, seed
        evaluator = RunningEvaluator(network)
        for version in (3, 4):
            snapshot = learner.snapshot(version)
            snapshot.weights["policy_head.bias"][:] = 0.0 if version == 3 else [0.0, 99.0, 0.0, 0.0]
            learner.give(snapshot)
            report = learner.receive_report()
            assert (report.policy_version, len(report.returns), report.note) == (version, 40, "")
            returns.append(report.returns.tolist())
        learner.give(Refusal(code="finished", reason="all episodes are played"))
        evaluator.join()
        assert evaluator.finished
        assert [each.spaces for each in learner.joins.queue] == [None, SPACES]  # checked before it plays
        learner.transport.close()
    assert returns[0] == returns[2] != returns[4]
    assert returns[1] == returns[3] != returns[0]


def test_evaluator_plays_the_next_plan_if_it_was_too_slow_for_the_first(network: MemoryNetwork) -> None:
    """While it made its environments, others have played all that there was to play."""

    class OfTwoPlans(ScriptedLearner):
        def answer_join(self, request: Request) -> None:
            super().answer_join(request)
            self.epoch = 2

    learner = OfTwoPlans(network, run_spec(seconds=1000.0))
    learner.play_episodes, learner.play_seed = 2, 5
    evaluator = RunningEvaluator(network)
    learner.give(learner.snapshot(3, epoch=2))
    assert learner.receive_report().learner_epoch == 2
    evaluator.end(learner)


def test_evaluated_episodes_are_not_cut_by_the_no_reward_limit(network: MemoryNetwork) -> None:
    """The first reward of the first episode is 0, at which training would cut it."""
    learner = ScriptedLearner(network, run_spec(no_reward_limit=1))
    evaluator = RunningEvaluator(network)
    learner.give(learner.snapshot(version=1))
    assert learner.receive_report().lengths.tolist() == [3, 3]
    evaluator.end(learner)


def test_each_evaluation_uses_the_policy_given_then(learner: ScriptedLearner, evaluator: RunningEvaluator) -> None:
    for version, action in ((5, 3), (6, 1), (8, 0)):
        learner.give(learner.snapshot(version, action))
        report = learner.receive_report()
        assert report.policy_version == version
        # The environments are reused: a reset begins the episode after the last.
        actions = (report.returns * 10).round() % 10
        assert actions.tolist() == [(action * report.lengths[0]) % 10] * 2


def test_evaluator_does_not_join_as_an_actor(learner: ScriptedLearner, evaluator: RunningEvaluator) -> None:
    learner.give(learner.snapshot(0))
    learner.receive_report()
    assert learner.joins.get(timeout=LIMIT) == JOIN
    assert learner.joins.empty()  # once, and without spaces: it is no actor
    assert learner.present == []


def test_failure_of_an_evaluator_is_reported_to_its_learner(network: MemoryNetwork) -> None:
    learner = ScriptedLearner(network, run_spec(id="absent_environment:Absent-v0"))
    evaluator = RunningEvaluator(network)
    evaluator.join()
    *_, failed = learner.joins.queue
    assert "absent_environment" in failed.failure
    assert failed == replace(JOIN, failure=str(evaluator.error))


def test_evaluator_plays_as_many_episodes_as_the_run_says(network: MemoryNetwork) -> None:
    learner = ScriptedLearner(network, run_spec(episodes=40))  # more than the 32 environments of training
    evaluator = RunningEvaluator(network)
    learner.give(learner.snapshot(0))
    assert learner.receive_report().lengths.tolist() == [3] * 32 + [2] * 8
    evaluator.end(learner)


def test_rejected_report_is_logged_and_the_next_evaluation_follows(
    learner: ScriptedLearner, evaluator: RunningEvaluator
) -> None:
    learner.give(learner.snapshot(1))
    learner.receive_report("rejected", "no such version")
    learner.give(learner.snapshot(2))
    assert learner.receive_report().policy_version == 2
    assert "the learner rejected the evaluation: no such version" in LINES


# ----------------------------------------------------------------------------------------- losing the learner


def test_learner_without_a_policy_is_asked_again(learner: ScriptedLearner, evaluator: RunningEvaluator) -> None:
    learner.give(Refusal(code="not_ready", reason="no policy yet"))
    learner.give(learner.snapshot(1))
    assert learner.receive_report().policy_version == 1


def test_policy_of_another_learner_epoch_is_not_evaluated_before_joining_it(
    learner: ScriptedLearner, evaluator: RunningEvaluator
) -> None:
    learner.epoch = 2  # the learner restarted, with the same keys
    learner.give(learner.snapshot(9))
    assert [learner.joins.get(timeout=LIMIT) for _ in range(2)] == [JOIN] * 2
    learner.give(learner.snapshot(3))
    report = learner.receive_report()
    assert (report.learner_epoch, report.policy_version) == (2, 3)


def test_evaluator_looks_for_a_learner_that_went_away(
    network: MemoryNetwork, learner: ScriptedLearner, evaluator: RunningEvaluator
) -> None:
    _, request_for_a_policy = learner.receive()
    learner.transport.close()
    request_for_a_policy.reply(b"a dying learner's answer")
    while not any(text.startswith("ignored a damaged message") for text in LINES):
        evaluator.stop.wait(0.001)
    second = ScriptedLearner(network, run_spec(), epoch=2)
    second.give(second.snapshot(0))
    report = second.receive_report()
    assert (report.learner_epoch, report.policy_version) == (2, 0)
    evaluator.end(second)


def test_evaluator_may_start_before_the_learner(network: MemoryNetwork) -> None:
    evaluator = RunningEvaluator(network)
    learner = ScriptedLearner(network, run_spec())
    learner.give(learner.snapshot(4))
    assert learner.receive_report().policy_version == 4
    evaluator.end(learner)


def test_evaluator_ends_after_its_timeout_without_a_learner(network: MemoryNetwork) -> None:
    evaluator = RunningEvaluator(network, timeout=0.05)
    evaluator.join()
    assert isinstance(evaluator.error, ActorError)
    assert "no learner answered within 0.05 s" in str(evaluator.error)


# ---------------------------------------------------------------------------------------------------- its end


def test_evaluator_ends_when_the_run_is_over(learner: ScriptedLearner, evaluator: RunningEvaluator) -> None:
    learner.give(Refusal(code="finished", reason="solved"))
    evaluator.join()
    assert evaluator.error is None
    assert LINES[-1] == "the run is over"


def test_evaluator_stops_between_evaluations(network: MemoryNetwork) -> None:
    learner = ScriptedLearner(network, run_spec(seconds=1e6))
    evaluator = RunningEvaluator(network)
    learner.joins.get(timeout=LIMIT)
    evaluator.stop.set()
    evaluator.join()
    assert evaluator.error is None
    assert LINES[-1] == "this process was stopped"
    assert learner.received.empty()


class Endless:
    """Environments whose episodes do not end, and that report when they are stepped."""

    count, seats, spaces = 2, 1, SPACES

    def __init__(self) -> None:
        self.seeds: list[int] = []
        self.playing, self.closed = threading.Event(), threading.Event()

    def reset(self, seed: int) -> Observed:
        self.seeds.append(seed)
        return Observed({NAME: np.zeros((2, 2), np.float32)}, {})

    def step(self, actions: dict[str, np.ndarray]) -> Step:
        self.playing.set()
        observed = Observed({NAME: np.zeros((2, 2), np.float32)}, {})
        return observed, np.zeros(2), np.full(2, self.over), np.zeros(2, np.bool_)

    def take_episode_info(self) -> dict[str, np.ndarray]:
        return {}

    def close(self) -> None:
        self.closed.set()

    over = False


class Brief(Endless):
    over = True


def test_evaluator_stops_in_the_middle_of_an_episode_and_closes_its_environments(
    network: MemoryNetwork, learner: ScriptedLearner, monkeypatch: pytest.MonkeyPatch
) -> None:
    endless = Endless()
    monkeypatch.setattr("daedalus.actor.evaluation.evaluator.make_environments", lambda *_, **__: endless)
    evaluator = RunningEvaluator(network)
    learner.give(learner.snapshot(0))
    assert endless.playing.wait(LIMIT)
    evaluator.stop.set()
    evaluator.join()
    assert evaluator.error is None
    assert LINES[-1] == "this process was stopped"
    assert endless.closed.is_set()
    assert learner.received.empty()  # an unfinished evaluation is not reported


def test_evaluations_have_different_seeds_and_the_same_ones_after_a_restart(
    network: MemoryNetwork, monkeypatch: pytest.MonkeyPatch
) -> None:
    seeds = []
    for _ in range(2):
        learner = ScriptedLearner(network, run_spec())
        brief = Brief()
        monkeypatch.setattr("daedalus.actor.evaluation.evaluator.make_environments", lambda *_, made=brief, **__: made)
        evaluator = RunningEvaluator(network)
        for version in range(3):
            learner.give(learner.snapshot(version))
            learner.receive_report()
        evaluator.end(learner)
        seeds.append(brief.seeds[:3])
    assert len(set(seeds[0])) == 3
    assert seeds[0] == seeds[1]
