"""learner/serving/evaluator_host.py: which evaluator plays which policy, and what ends the episodes."""

import threading
from collections.abc import Callable, Iterator, Set
from contextlib import contextmanager
from typing import Any

import numpy as np
import pytest
from plain import vector_spaces
from processes import LIMIT, until

from daedalus.learner.serving.evaluator_host import EpisodePlan, EvaluatorError, Evaluators, OfferedPolicy, play
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
)
from daedalus.protocol.spec import EnvironmentSpec, RunSpec
from daedalus.transport.memory import MemoryNetwork, MemoryTransport

SPACES = vector_spaces(2, 4)
PLAN = EpisodePlan(
    run="r",
    spec=RunSpec(environment=EnvironmentSpec(id="A-v0")),
    environment=EnvironmentSpec(id="A-v0"),
    spaces=SPACES,
    episodes=2,
    seed=7,
    actions="greedy",
)
PROGRAMS = [Program(hash=name * 64, model=np.zeros(1, np.uint8)) for name in "ab"]
POLICIES = [
    OfferedPolicy(policy_version=version, program=PROGRAMS[version % 2], weights={"w": np.full(1, version, np.float32)})
    for version in (3, 5, 8)
]
Ask = Callable[[str, Any], Message]


def played(script: Callable[[Ask], object]) -> tuple[list[EvaluationReport] | None, set[str]]:
    """Let `script` ask as evaluators do; return what came of it, and which evaluators have left."""
    left: set[str] = set()
    network = MemoryNetwork()
    transport = MemoryTransport(network)

    def ask(key: str, message: Any) -> Message:
        answers = list[bytes]()
        payload = b"" if message is None else encode(message)
        until(lambda: bool(answers.extend(transport.query(key, payload, timeout=LIMIT)) or answers))
        return decode(answers[0], Limits())

    def failure(dismissed: Set[str]) -> str:
        left.update(dismissed)
        return ""

    thread = threading.Thread(target=script, args=[ask])

    @contextmanager
    def evaluators() -> Iterator[Evaluators]:
        thread.start()
        try:
            yield Evaluators(MemoryTransport(network), failure)
        finally:
            thread.join(LIMIT)

    return play(PLAN, POLICIES, evaluators, thread.is_alive), left


def request(ask: Ask, evaluator: str) -> Message:
    return ask(keys.evaluations("r", evaluator), EvaluationRequest(evaluator=evaluator))


def report(ask: Ask, evaluator: str, version: int, episodes: int = 2) -> Message:
    returns, lengths = np.full(episodes, float(version)), np.ones(episodes, np.int32)
    message = EvaluationReport(
        evaluator=evaluator, learner_epoch=1, policy_version=version, returns=returns, lengths=lengths
    )
    return ask(keys.evaluations("r", evaluator), message)


def test_each_policy_is_played_by_one_evaluator_and_again_by_one_that_was_restarted() -> None:
    def script(ask: Ask) -> None:
        for evaluator, version in (("p", 3), ("q", 5), ("p", 3)):
            snapshot = request(ask, evaluator)
            assert isinstance(snapshot, Snapshot)
            assert (snapshot.policy_version, snapshot.weights["w"].tolist()) == (version, [version])
            program = ask(keys.program("r", snapshot.program), None)
            assert isinstance(program, Program)
            assert program.hash == snapshot.program
        for version, episodes in ((3, 2), (5, 1)):
            verdict = report(ask, "q", version, episodes)  # of another evaluator; too few
            assert isinstance(verdict, Acknowledgement)
            assert verdict.verdict == "rejected"
        report(ask, "q", 5)
        request(ask, "q")
        refusal = request(ask, "spare")
        assert isinstance(refusal, Refusal)
        assert refusal.code == "finished"
        done.set()
        report(ask, "p", 3)
        report(ask, "q", 8)

    done = threading.Event()
    reports, left = played(script)
    assert done.is_set()
    assert reports is not None
    assert [(each.policy_version, each.returns.tolist()) for each in reports] == [(3, [3, 3]), (5, [5, 5]), (8, [8, 8])]
    assert left <= {"spare"}


@pytest.mark.parametrize(
    ("join", "reason"),
    [
        ({"failure": "no display"}, "no display"),
        (
            {"spaces": vector_spaces(9, 4), "environments": 1},
            r"A-v0 \(backend gymnasium\) has .*; the policy was trained",
        ),
    ],
)
def test_an_evaluator_that_cannot_play_ends_the_episodes_with_the_reason(join: dict[str, Any], reason: str) -> None:
    def script(ask: Ask) -> None:
        ask(keys.join("r", "p"), Join(actor="p", incarnation=1, **join))

    with pytest.raises(EvaluatorError, match=reason):
        played(script)
