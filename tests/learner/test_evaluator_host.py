"""learner/serving/evaluator_host.py: which evaluator plays which policy, and what ends the episodes."""

import contextlib
import threading
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from plain import vector_spaces
from processes import LIMIT

from daedalus.learner.serving.evaluator_host import EpisodePlan, EvaluatorError, EvaluatorHost, OfferedPolicy
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
from daedalus.protocol.spec import EnvironmentSpec, RunSpec
from daedalus.transport.memory import MemoryNetwork, MemoryTransport

SPACES = vector_spaces(2, 4)
PLAN = EpisodePlan(
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


def played(*scripts: Callable[[Ask], object]) -> list[list[EvaluationReport] | None]:
    """Play one plan for each script, which asks as evaluators do, and return what came of each."""
    network = MemoryNetwork()
    transport, host = MemoryTransport(network), EvaluatorHost("r", MemoryTransport(network))

    def ask(key: str, message: Any) -> Message:
        payload = b"" if message is None else encode(message)
        (answer,) = transport.query(key, payload, timeout=2.0 if isinstance(message, Join) else LIMIT)
        return decode(answer, Limits())

    def play(script: Callable[[Ask], object]) -> list[EvaluationReport] | None:
        thread = threading.Thread(target=script, args=[ask])
        begins = iter([thread.start])  # once the host plays
        reports = host.play(PLAN, POLICIES, lambda: bool([each() for each in begins]) or thread.is_alive())
        thread.join(LIMIT)
        return reports

    return [play(script) for script in scripts]


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
        report(ask, "q", 8)
        report(ask, "p", 3)

    (reports,) = played(script)
    assert reports is not None
    assert [(each.policy_version, each.returns.tolist()) for each in reports] == [(3, [3, 3]), (5, [5, 5]), (8, [8, 8])]


def test_an_evaluator_without_a_policy_waits_for_the_next_plan_and_joins_again() -> None:
    def first(ask: Ask) -> None:
        for evaluator in "pqs":
            request(ask, evaluator)
        idle.append(threading.Thread(target=lambda: answers.append(request(ask, "idle"))))
        idle[0].start()
        for evaluator, version in zip("pqs", (3, 5, 8), strict=True):
            report(ask, evaluator, version)

    def second(ask: Ask) -> None:
        idle[0].join(LIMIT)
        for evaluator, version in zip("pqs", (3, 5, 8), strict=True):
            answers.append(ask(keys.join("r", evaluator), Join(actor=evaluator, incarnation=1)))
            answers.append(request(ask, evaluator))
            report(ask, evaluator, version)

    answers, idle = list[Message](), list[threading.Thread]()
    assert None not in played(first, second)
    refusal, welcome, snapshot, *_ = answers
    assert isinstance(refusal, Refusal)
    assert refusal.code == "not_ready"
    assert isinstance(welcome, Welcome)
    assert isinstance(snapshot, Snapshot)
    assert welcome.learner_epoch == snapshot.learner_epoch == 2  # of the second plan


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
        with contextlib.suppress(ValueError):  # no answer: whoever watches the process learns of the reason first
            ask(keys.join("r", "p"), Join(actor="p", incarnation=1, **join))

    with pytest.raises(EvaluatorError, match=reason):
        played(script)
