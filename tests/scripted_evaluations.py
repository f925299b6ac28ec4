"""A learner for tests of evaluators, which answers as the test says, and an evaluator on a thread of its own."""

import contextlib
import queue
import threading
from typing import Any

import numpy as np
from allowed_modules import TEST_MODULES
from plain import vector_spaces
from processes import LIMIT

from daedalus.actor.evaluation.evaluator import Evaluator
from daedalus.actor.session.actor_config import ActorConfig
from daedalus.policy.acting.program import export_program
from daedalus.policy.acting.runtime import program_hash
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
        request.reply(encode(Program(hash=program_hash(MODEL), model=np.frombuffer(MODEL, np.uint8))))

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
