"""EvaluationServer of learner/training_loop.py: how often a policy is saved and handed out, however many ask for it."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from building import EPOCH, run_context

from daedalus.learner.serving.actor_server import ActorServer
from daedalus.learner.serving.evaluations import Evaluated
from daedalus.learner.training.checkpointer import Saving
from daedalus.learner.training_loop import EvaluationServer
from daedalus.protocol import keys
from daedalus.protocol.codec import decode, encode
from daedalus.protocol.limits import Limits
from daedalus.protocol.messages import (
    Acknowledgement,
    EvaluationReport,
    EvaluationRequest,
    Snapshot,
)
from daedalus.transport.memory import MemoryNetwork, MemoryTransport


class FakeLearner:
    """Learner with a policy version and one parameter."""

    policy_version = 1

    def weights(self) -> dict[str, np.ndarray]:
        return {"w": np.zeros(2, np.float32)}


class FakeCheckpointer:
    """Checkpointer that moves the clock instead of copying, and that writes as long as the test says."""

    def __init__(self, scene: "Scene") -> None:
        self._scene = scene
        self.saved_at: list[float] = []
        self.kept: list[Evaluated] = []
        self.idle, self.seconds = True, 0.0

    def begin(self, *, again: bool) -> Saving:
        assert self.idle
        assert not again
        self.saved_at.append(self._scene.now)
        self._scene.now += self._scene.save_seconds
        version = self._scene.learner.policy_version
        return Saving(version, 1000, Path(f"checkpoint-{version}"))

    def keep(self, evaluated: Evaluated) -> None:
        self.kept.append(evaluated)


class Scene:
    """Evaluators, and an evaluation server with a virtual clock."""

    def __init__(self) -> None:
        network = MemoryNetwork()
        self.now, self.save_seconds = 100.0, 0.0
        context = run_context()
        context.counters.env_steps = 1000
        self.actors = ActorServer(context, MemoryTransport(network), lambda: pytest.fail("no status is queried"))
        self.actors.open()
        self.actors.offer_policy(b"program", 0)
        self.evaluations = context.evaluations
        self.server = EvaluationServer(context, self.actors.evaluations, self.actors.publisher, clock=lambda: self.now)
        self.learner, self.checkpointer = FakeLearner(), FakeCheckpointer(self)
        self._transport = MemoryTransport(network)

    def send(self, message: EvaluationRequest | EvaluationReport) -> list[Any]:
        """Send a message, and return the list that its answer will be in."""
        answers: list[Any] = []
        self._transport.query_async(
            keys.evaluations("r", message.evaluator),
            encode(message),
            timeout=1.0,
            on_answer=lambda answer: answers.append(None if answer is None else decode(answer, Limits())),
        )
        return answers

    def request(self, evaluator: str = "e") -> list[Any]:
        return self.send(EvaluationRequest(evaluator=evaluator))

    def report(self, version: int, evaluator: str = "e") -> list[Any]:
        ones = np.ones(3, np.float32)
        return self.send(
            EvaluationReport(
                evaluator=evaluator,
                learner_epoch=EPOCH,
                policy_version=version,
                returns=ones,
                lengths=ones.astype(np.int32),
            )
        )

    def serve(self) -> None:
        self.server.serve(self.learner, self.checkpointer)  # type: ignore[arg-type] - fakes


@pytest.fixture
def scene() -> Any:
    made = Scene()
    yield made
    made.actors.close("the test is over")


def test_request_is_answered_at_once_with_the_newest_policy(scene: Scene) -> None:
    scene.learner.policy_version = 7
    answers = scene.request()
    scene.serve()
    assert isinstance(answers[0], Snapshot)
    assert answers[0].policy_version == 7
    assert scene.evaluations.in_progress == {"e": (Path("checkpoint-7"), 7, 1000)}


def test_all_waiting_evaluators_get_the_same_policy_of_one_save(scene: Scene) -> None:
    answers = [scene.request(f"e{number}") for number in range(10)]
    scene.serve()
    assert len(scene.checkpointer.saved_at) == 1
    assert {answer[0].policy_version for answer in answers} == {1}
    assert len(scene.evaluations.in_progress) == 10


def test_nothing_is_saved_without_a_request(scene: Scene) -> None:
    scene.serve()
    assert scene.checkpointer.saved_at == []


@pytest.mark.parametrize(("save", "pause"), [(0.0, 0.5), (0.01, 0.5), (0.1, 2.0), (10.0, 30.0)])
def test_requests_wait_until_a_save_is_due_again(scene: Scene, save: float, pause: float) -> None:
    scene.save_seconds = save
    scene.request()
    scene.serve()
    done = scene.now
    scene.save_seconds = 0.0
    for share in (0.0, 0.5, 0.99):
        scene.now = done + share * pause
        answers = scene.request()
        scene.serve()
        assert answers == []  # and no refusal: an honest evaluator only waits
    scene.now = done + 1.01 * pause
    scene.serve()
    assert isinstance(answers[0], Snapshot)


def test_flood_of_requests_takes_at_most_a_twentieth_of_the_time(scene: Scene) -> None:
    scene.save_seconds = 0.2
    for number in range(93 * 60):
        scene.now += 1.0 / 93
        scene.learner.policy_version += 1
        scene.request(f"flood-{number % 30}")
        scene.serve()
    assert 0.2 * len(scene.checkpointer.saved_at) / 60.0 <= 0.06


def test_evaluator_that_asks_rarely_never_waits(scene: Scene) -> None:
    for _ in range(5):
        answers = scene.request()
        scene.serve()
        assert isinstance(answers[0], Snapshot)
        scene.now += 0.6


def test_reports_are_answered_while_requests_wait(scene: Scene) -> None:
    scene.request()
    scene.serve()
    waiting = scene.request("f")
    answers = scene.report(1)
    scene.serve()
    assert isinstance(answers[0], Acknowledgement)
    assert answers[0].verdict == "accepted"
    assert waiting == []


def test_evaluator_waits_only_while_an_earlier_checkpoint_is_written(scene: Scene) -> None:
    """Where each checkpoint takes minutes, evaluations go on: the policy is handed out before it is written."""
    scene.checkpointer.idle = False
    answers = scene.request()
    scene.serve()
    assert answers == []
    scene.checkpointer.idle, scene.checkpointer.seconds = True, 105.0
    scene.serve()
    assert isinstance(answers[0], Snapshot)
    assert scene.evaluations.heard == scene.now
    scene.now += 29.0
    again = scene.request()
    scene.serve()
    assert again == []  # writing takes time too, of other threads
    scene.now += 2.0
    scene.serve()
    assert isinstance(again[0], Snapshot)
    answers = scene.report(1)
    scene.checkpointer.idle = False
    scene.serve()
    assert answers[0].verdict == "accepted"  # at once; the checkpoint is kept later
    assert [each.policy_version for each in scene.checkpointer.kept] == [1]
