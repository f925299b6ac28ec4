"""learner/serving/query_responses.py: answers before, during and after a run."""

import struct
from dataclasses import replace
from pathlib import Path

import numpy as np
from building import run_context
from plain import vector_spaces

from daedalus.learner.serving.fleet import Fleet
from daedalus.learner.serving.query_responses import JoinResponses, page
from daedalus.learner.serving.snapshot_publisher import SnapshotPublisher
from daedalus.protocol.codec import PROTOCOL_VERSION, decode, encode
from daedalus.protocol.limits import Limits
from daedalus.protocol.messages import (
    Acknowledgement,
    ClientReport,
    Join,
    Message,
    Origin,
    Program,
    Refusal,
    RunEnded,
    Snapshot,
    Welcome,
)
from daedalus.protocol.releases import own_release
from daedalus.protocol.spaces import ArraySpace, DiscreteSpace, Spaces
from daedalus.protocol.spec import EnvironmentSpec, RunSpec
from daedalus.transport.memory import MemoryNetwork, MemoryTransport

SPACES = vector_spaces(4, 2)
SPEC = RunSpec(environment=EnvironmentSpec(id="CartPole-v1"))


def make_responses() -> tuple[JoinResponses, Fleet]:
    context = run_context(SPEC, Path("run"), spaces=None, learner_epoch=5)
    return JoinResponses(context), context.fleet


def make_publisher() -> SnapshotPublisher:
    return SnapshotPublisher(run_context(), MemoryTransport(MemoryNetwork()))


def read(data: bytes) -> Message:
    return decode(data, Limits())


def test_welcome_contains_run_epoch_specification_and_seed() -> None:
    responses, fleet = make_responses()
    answer = read(responses.join("a", encode(Join(actor="a", incarnation=1)), 0.0))
    assert isinstance(answer, Welcome)
    assert (answer.run, answer.learner_epoch, answer.spec) == ("run", 5, SPEC.for_actors())
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


ORIGIN = Origin(host="arm-box", software="daedalus-rl 9.9", address="tcp/10.0.0.7:43092")


def test_join_of_another_protocol_version_is_listed_with_its_host_and_version() -> None:
    responses, fleet = make_responses()
    data = bytearray(encode(Join(actor="a", incarnation=1, origin=ORIGIN)))
    struct.pack_into("<H", data, 4, PROTOCOL_VERSION + 1)
    answer = read(responses.join("a", bytes(data), 0.0))
    assert isinstance(answer, Refusal)
    assert answer.code == "mismatch"
    (listed,) = fleet.refused_joins.report(0.0)
    assert (listed.actor, listed.host, listed.software) == ("a", "arm-box", "daedalus-rl 9.9")
    own = own_release()
    remedy = f"upgrade the end that has {own} to daedalus-rl 9.9"
    assert listed.reason == f"{own} cannot read messages of daedalus-rl 9.9: {remedy}"
    assert answer.software == own


def test_failure_that_an_actor_reports_is_listed_and_answered() -> None:
    responses, fleet = make_responses()
    failed = Join(actor="a", incarnation=1, origin=ORIGIN, failure="x" * 1000)
    answer = read(responses.join("a", encode(failed), 0.0))
    assert answer == Refusal(code="failed", reason="x" * 300)
    (listed,) = fleet.refused_joins.report(0.0)
    assert (listed.host, listed.reason) == ("arm-box", "x" * 300)


def test_refused_actor_is_listed_until_it_has_joined() -> None:
    responses, fleet = make_responses()
    spaces = vector_spaces(4, 2)
    joining = Join(actor="a", incarnation=1, spaces=spaces, environments=1, origin=ORIGIN)
    responses.join("b", encode(joining), 0.0)  # the key of another actor
    responses.join("a", encode(replace(joining, environments=0)), 0.0)
    assert [each.actor for each in fleet.refused_joins.report(0.0)] == ["b", "a"]
    assert isinstance(read(responses.join("a", encode(joining), 0.0)), Welcome)
    assert [each.actor for each in fleet.refused_joins.report(0.0)] == ["b"]
    assert fleet.actors["a"].origin == ORIGIN


def test_program_is_found_by_its_hash_and_by_a_wildcard() -> None:
    publisher = make_publisher()
    early = read(publisher.program("*"))
    assert isinstance(early, Refusal)
    assert early.code == "unknown"
    publisher.offer_program(b"model")
    current = read(publisher.program("*"))
    assert isinstance(current, Program)
    assert publisher.program(current.hash) == publisher.program("*")
    unknown = read(publisher.program("x" * 1000))
    assert isinstance(unknown, Refusal)
    assert unknown.code == "unknown"


def test_snapshot_query_returns_refusal_then_snapshot_then_run_ended() -> None:
    publisher = make_publisher()
    first = read(publisher.snapshot())
    assert isinstance(first, Refusal)
    assert first.code == "not_ready"
    publisher.publish(4, {"w": np.zeros(1, np.float32)})
    newest = read(publisher.snapshot())
    assert isinstance(newest, Snapshot)
    assert newest.policy_version == 4
    assert publisher.snapshot(3) == publisher.snapshot()
    unchanged = read(publisher.snapshot(4))
    assert isinstance(unchanged, Refusal)
    assert unchanged.code == "not_ready"
    publisher.end(b"run_ended")
    publisher.publish(5, {"w": np.zeros(1, np.float32)})  # by a learner that is in an update
    assert publisher.snapshot() == publisher.snapshot(4) == b"run_ended"


def test_join_after_the_end_is_refused() -> None:
    responses, _ = make_responses()
    responses.end(finished=True)
    late = read(responses.join("a", encode(Join(actor="a", incarnation=1)), 0.0))
    assert isinstance(late, Refusal)
    assert late.code == "finished"


def test_join_with_observations_too_large_for_memory_is_refused_and_fixes_no_spaces() -> None:
    """Such a Join once ended the learner: it allocated the batch."""
    responses, fleet = make_responses()
    huge = ArraySpace.model_construct(kind="array", shape=(2**40,), dtype="float32", frames=1)
    spaces = Spaces.model_construct(observations={"observation": huge}, actions={"action": DiscreteSpace(counts=(2,))})
    answer = read(responses.join("a", encode(Join(actor="a", incarnation=1, spaces=spaces, environments=1)), 0.0))
    assert isinstance(answer, Refusal)
    assert "use at most" in answer.reason
    assert fleet.spaces is None


def test_report_of_a_client_is_in_its_status_until_it_is_restarted() -> None:
    responses, fleet = make_responses()
    joining = Join(actor="a", incarnation=1, spaces=SPACES, environments=1)
    responses.join("a", encode(joining), 0.0)
    report = ClientReport(actor="a", incarnation=1, deadlines=9, missed_deadlines=2, safe_reason="x" * 1000)
    assert read(responses.report("a", encode(report), 7.0)) == Acknowledgement(verdict="accepted")
    (status,) = page(fleet, "", 0.0)
    assert (status.deadlines, status.missed_deadlines, len(status.safe_reason)) == (9, 2, 300)
    responses.join("a", encode(replace(joining, incarnation=2)), 0.0)
    (status,) = page(fleet, "", 0.0)
    assert (status.deadlines, status.safe_reason) == (0, "")


def test_report_that_is_not_of_the_actor_of_its_key_is_refused() -> None:
    responses, fleet = make_responses()
    responses.join("a", encode(Join(actor="a", incarnation=1, spaces=SPACES, environments=1)), 0.0)
    for report in (ClientReport(actor="b", incarnation=1), ClientReport(actor="a", incarnation=2)):
        answer = read(responses.report("a", encode(report), 7.0))
        assert isinstance(answer, Refusal)
        assert answer.code == "unknown"
    for data in (b"", b"DAED", encode(Join(actor="a", incarnation=1))):
        answer = read(responses.report("a", data, 7.0))
        assert isinstance(answer, Refusal)
        assert answer.code == "malformed"
    assert fleet.actors["a"].report is None
