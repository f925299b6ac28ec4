"""learner/serving/query_responses.py: answers before, during and after a run."""

import threading

import numpy as np

from daedalus.learner.serving.fleet import Fleet
from daedalus.learner.serving.query_responses import QueryResponses
from daedalus.protocol.codec import decode, encode
from daedalus.protocol.limits import Limits
from daedalus.protocol.messages import Join, Message, Program, Refusal, RunEnded, Welcome
from daedalus.protocol.spaces import ArraySpace, DiscreteSpace, Spaces
from daedalus.protocol.spec import EnvironmentSpec, RunSpec

SPEC = RunSpec(environment=EnvironmentSpec(id="CartPole-v1"))


def make_responses() -> tuple[QueryResponses, Fleet]:
    fleet = Fleet(seed=1, spaces=None)
    return QueryResponses("run", SPEC, 5, 0, fleet, threading.Condition()), fleet


def read(data: bytes) -> Message:
    return decode(data, Limits())


def test_welcome_contains_run_epoch_specification_and_seed() -> None:
    responses, fleet = make_responses()
    answer = read(responses.join("a", encode(Join(actor="a", incarnation=1)), 0.0))
    assert isinstance(answer, Welcome)
    assert (answer.run, answer.learner_epoch, answer.spec) == ("run", 5, SPEC)
    assert answer.seed == fleet.seed_for("a", 0)


def test_message_that_is_not_a_join_is_refused() -> None:
    responses, fleet = make_responses()
    for data, code in (
        (b"\xff", "mismatch"),
        (encode(RunEnded(learner_epoch=1, outcome="finished", reason="")), "malformed"),
    ):
        answer = read(responses.join("a", data, 0.0))
        assert isinstance(answer, Refusal)
        assert answer.code == code
    assert not fleet.actors


def test_program_is_found_by_its_hash() -> None:
    responses, _ = make_responses()
    program = Program(hash="abc", model=np.zeros(3, np.uint8))
    responses.offer_program(program)
    answer = read(responses.program("abc"))
    assert isinstance(answer, Program)
    unknown = read(responses.program("x" * 1000))
    assert isinstance(unknown, Refusal)
    assert unknown.code == "unknown"


def test_wildcard_returns_the_current_program() -> None:
    responses, _ = make_responses()
    early = read(responses.program("*"))
    assert isinstance(early, Refusal)
    assert early.code == "unknown"
    responses.offer_program(Program(hash="abc", model=np.zeros(3, np.uint8)))
    answer = read(responses.program("*"))
    assert isinstance(answer, Program)
    assert answer.hash == "abc"


def test_snapshot_query_returns_refusal_then_snapshot_then_run_ended() -> None:
    responses, _ = make_responses()
    first = read(responses.snapshot())
    assert isinstance(first, Refusal)
    assert first.code == "not_ready"
    responses.offer_snapshot(b"newest", 4)
    assert responses.snapshot() == responses.snapshot(3) == b"newest"
    unchanged = read(responses.snapshot(4))
    assert isinstance(unchanged, Refusal)
    assert unchanged.code == "not_ready"
    responses.end(b"run_ended", finished=True)
    assert responses.snapshot() == responses.snapshot(4) == b"run_ended"
    late = read(responses.join("a", encode(Join(actor="a", incarnation=1)), 0.0))
    assert isinstance(late, Refusal)
    assert late.code == "finished"


def test_join_with_observations_too_large_for_memory_is_refused_and_fixes_no_spaces() -> None:
    """Such a Join once ended the learner: it allocated the batch."""
    responses, fleet = make_responses()
    huge = ArraySpace.model_construct(kind="array", shape=(2**40,), dtype="float32", frames=1)
    spaces = Spaces.model_construct(observation=huge, action=DiscreteSpace(count=2))
    answer = read(responses.join("a", encode(Join(actor="a", incarnation=1, spaces=spaces, environments=1)), 0.0))
    assert isinstance(answer, Refusal)
    assert "use at most" in answer.reason
    assert fleet.spaces is None
