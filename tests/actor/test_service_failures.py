"""ActorService against a scripted learner, over the memory transport: failures, refusals and the end of the run."""

import contextlib
import socket
import struct
import threading

import pytest
from log_lines import LINES
from processes import LIMIT, until
from scripted_learner import SPACES, SPEC, RunningActor, ScriptedLearner, acknowledge

from daedalus.actor.errors import ActorError
from daedalus.actor.session import learner_queries, runtime_maker, service, session_monitor
from daedalus.actor.session.run_end import RunEndWatch, RunOverError
from daedalus.protocol import keys
from daedalus.protocol.codec import PROTOCOL_VERSION, encode
from daedalus.protocol.messages import Acknowledgement, Join, Refusal, RunEnded, Welcome, new_epoch
from daedalus.transport.interface import RefusedError, TransportError
from daedalus.transport.memory import MemoryNetwork, MemoryTransport


@pytest.mark.parametrize("how", ["fenced", "left"])
def test_actor_joins_again_after_the_learner_restarted(network: MemoryNetwork, actor: RunningActor, how: str) -> None:
    first = ScriptedLearner(network)
    first.publish(4)
    _, request = first.receive()
    if how == "fenced":
        first.epoch = 2
        first.publish(0, push=False)
        acknowledge(request, "fenced")
        second = first
    else:
        first.transport.close()
        second = ScriptedLearner(network, epoch=2)
        second.publish(0)
    while (received := second.receive())[0].identity.learner_epoch == 1:
        acknowledge(received[1], "fenced")
    assert received[0].identity.sequence == 0
    assert any("went away" in text for text in LINES)


@pytest.mark.parametrize("how", ["run_ended", "finished"])
def test_actor_ends_when_the_run_is_over(network: MemoryNetwork, actor: RunningActor, how: str) -> None:
    learner = ScriptedLearner(network)
    learner.publish(0)
    _, request = learner.receive()
    if how == "run_ended":
        learner.transport.publish(
            keys.run_end("r"), encode(RunEnded(learner_epoch=1, outcome="finished", reason="solved"))
        )
        acknowledge(request, "accepted")
    else:
        acknowledge(request, "finished")
    actor.join()
    assert actor.error is None
    assert LINES[-1].startswith("the run is over")


@pytest.mark.parametrize("how", ["verdict", "refused join"])
def test_drained_actor_ends(
    network: MemoryNetwork, actor: RunningActor, how: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The join is refused if the actor sends nothing, because it waits for the other actors of a2c."""
    monkeypatch.setattr(session_monitor, "_SILENCE_SECONDS", 1e6 if how == "verdict" else 0.1)
    learner = ScriptedLearner(network)
    learner.publish(0)
    _, request = learner.receive()
    if how == "verdict":
        acknowledge(request, "drained")
    else:
        learner.refusal = Refusal(code="drained", reason="why")
    actor.join()
    assert actor.error is None
    assert LINES[-1] == "an operator drained this actor: it leaves the run"


def test_damaged_message_is_logged_and_ignored(network: MemoryNetwork, actor: RunningActor) -> None:
    learner = ScriptedLearner(network)
    learner.publish(0)
    _, request = learner.receive()
    learner.snapshot = b"\xff" * 100
    acknowledge(request, "accepted")

    def ignored() -> bool:
        """Accept rollouts until the actor has fetched the snapshot: how many depends on when it misses one."""
        if any("ignored a damaged message" in text for text in LINES):
            return True
        _, request = learner.receive()
        acknowledge(request, "accepted")
        return False

    until(ignored)


def test_refusal_ends_the_actor_with_the_reason(network: MemoryNetwork) -> None:
    learner = ScriptedLearner(network)
    learner.refusal = Refusal(code="mismatch", reason="its environment has 3 choices")
    actor = RunningActor(network)
    actor.join()
    assert isinstance(actor.error, ActorError)
    assert "its environment has 3 choices" in str(actor.error)

    assert not any(join.failure for join in learner.joins.queue)  # the learner knows the reason


@pytest.mark.parametrize("when", ["join", "rollout"])
def test_reason_of_a_learner_neither_forges_a_line_nor_commands_the_terminal(network: MemoryNetwork, when: str) -> None:
    learner, reason = ScriptedLearner(network), "no\x1b]0;owned\x07\nactor: joined"
    if when == "join":
        learner.refusal = Refusal(code="mismatch", reason=reason)
    actor = RunningActor(network)
    if when == "rollout":
        learner.publish(0)
        _, request = learner.receive()
        request.reply(encode(Acknowledgement(verdict="quarantined", reason=reason)))
    actor.join()
    assert "this actor: no ]0;owned actor: joined" in str(actor.error)


def test_failure_of_an_actor_is_reported_to_its_learner(network: MemoryNetwork) -> None:
    environment = SPEC.environment.model_copy(update={"id": "absent_environment:Absent-v0"})
    learner = ScriptedLearner(network, SPEC.model_copy(update={"environment": environment}))
    actor = RunningActor(network)
    actor.join()
    *_, failed = learner.joins.queue
    assert failed.failure == str(actor.error)
    assert "absent_environment" in failed.failure
    assert (failed.actor, failed.spaces, failed.origin.host) == ("a", None, socket.gethostname())
    assert failed.origin.software.startswith("daedalus-rl ")


def test_run_that_uses_a_setting_of_a_newer_release_is_refused_and_the_learner_notified(network: MemoryNetwork) -> None:
    learner = ScriptedLearner(network)
    learner.newer = ("environment.newer",)
    actor = RunningActor(network)
    actor.join()
    assert isinstance(actor.error, ActorError)
    assert str(actor.error).startswith("the run sets environment.newer, which this release does not know: upgrade")
    assert [join.failure for join in learner.joins.queue] == ["", str(actor.error)]


def test_unexpected_error_is_reported_with_its_type(network: MemoryNetwork, monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(*_: object) -> None:
        raise ZeroDivisionError("a fault of a simulator")

    monkeypatch.setattr(service.ActorService, "_collect", fail)
    learner = ScriptedLearner(network)
    actor = RunningActor(network)
    learner.publish(0)
    actor.join()
    *_, failed = learner.joins.queue
    assert failed.failure == "ZeroDivisionError: a fault of a simulator"


def test_actor_whose_rollouts_the_learner_cannot_take_ends_with_the_setting_to_raise(network: MemoryNetwork) -> None:
    """The network drops such a message in silence: nobody would ever answer it."""
    service = SPEC.service.model_copy(update={"queue_megabytes": 0.0001})
    learner = ScriptedLearner(network, SPEC.model_copy(update={"service": service}))
    actor = RunningActor(network)
    learner.publish(0)
    actor.join()
    assert isinstance(actor.error, ActorError)
    for setting in ("collection.envs_per_actor", "collection.rollout_length", "service.queue_megabytes"):
        assert setting in str(actor.error)
    assert learner.rollouts.empty()


def test_actor_ends_with_the_reason_when_its_certificate_is_refused(
    network: MemoryNetwork, monkeypatch: pytest.MonkeyPatch
) -> None:
    def reopen(_: MemoryTransport) -> bool:
        raise RefusedError("the certificate expired on 2030-01-01: renew it")

    monkeypatch.setattr(MemoryTransport, "reopen", reopen)
    monkeypatch.setattr(learner_queries, "_REOPEN_SECONDS", 0.02)
    actor = RunningActor(network)
    actor.join()
    assert isinstance(actor.error, ActorError)
    assert str(actor.error) == "the certificate expired on 2030-01-01: renew it"


def test_two_learners_require_a_choice(network: MemoryNetwork) -> None:
    for run in ("one", "two"):
        transport = MemoryTransport(network)
        welcome = encode(Welcome(run=run, learner_epoch=1, seed=1, spec=SPEC.for_actors()))
        transport.serve(keys.join(run, "*"), lambda request, welcome=welcome: request.reply(welcome))
    actor = RunningActor(network)
    actor.join()
    assert "several learners answer here (one, two): choose one with --run" in str(actor.error)


def test_actors_keep_to_the_newer_of_two_learners_of_one_run(
    network: MemoryNetwork, monkeypatch: pytest.MonkeyPatch
) -> None:
    older, newer = ScriptedLearner(network, epoch=new_epoch(1)), ScriptedLearner(network, epoch=new_epoch(2))
    older.publish(0)
    newer.publish(0, push=False)
    actor = RunningActor(network)
    until(lambda: any(line.startswith("2 learners of run 'r' answer") for line in LINES))
    until(lambda: "waiting for the older learner to step down" in LINES)
    assert older.rollouts.empty()
    older.transport.close()
    assert newer.receive()[0].identity.learner_epoch == newer.epoch
    actor.stop.set()
    actor.join()
    assert actor.error is None


def test_an_older_learner_that_does_not_step_down_is_not_waited_for(
    network: MemoryNetwork, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(learner_queries, "_STEP_DOWN_SECONDS", 0.05)
    older, newer = ScriptedLearner(network, epoch=new_epoch(1)), ScriptedLearner(network, epoch=new_epoch(2))
    transport = MemoryTransport(network)
    end = RunEndWatch(transport, threading.Event())
    join = Join(actor="a", incarnation=1)
    welcome = learner_queries.LearnerQueries(transport).join_learner("*", join, None, end)
    assert welcome.learner_epoch == newer.epoch
    assert older.epoch < newer.epoch


@pytest.mark.parametrize(("starts", "is_over"), [(1, False), (2, True), (3, True)])
def test_only_an_older_learner_cannot_say_that_the_run_is_over(
    network: MemoryNetwork, starts: int, is_over: bool
) -> None:
    """Two processes that resumed from the same checkpoint differ in random bits only: either may end the run."""
    end = RunEndWatch(MemoryTransport(network), threading.Event())
    end.follow("r", new_epoch(2))
    finished = RunEnded(learner_epoch=new_epoch(starts), outcome="finished", reason="solved")
    MemoryTransport(network).publish(keys.run_end("r"), encode(finished))
    with pytest.raises(RunOverError) if is_over else contextlib.nullcontext():
        end.check()


@pytest.mark.parametrize("others", [0, 1])
def test_an_answer_of_another_release_is_ignored_beside_one_of_ours(network: MemoryNetwork, others: int) -> None:
    foreign = MemoryTransport(network)
    foreign.serve(keys.join("three", "*"), lambda request: request.reply(of_another_release()))
    learners = [ScriptedLearner(network, run="r") for _ in range(others)]
    actor = RunningActor(network)
    if not learners:
        actor.join()
        assert "protocol version" in str(actor.error)
        return
    learners[0].publish(0)
    learners[0].receive()
    assert any("ignored the answer of another learner: the other end uses protocol version" in text for text in LINES)
    actor.stop.set()
    actor.join()
    assert actor.error is None


def of_another_release() -> bytes:
    newer = bytearray(encode(Refusal(code="not_ready", reason="")))
    struct.pack_into("<H", newer, 4, PROTOCOL_VERSION + 1)
    return bytes(newer)


def test_actor_that_waits_for_another_run_names_the_runs_that_are_there(network: MemoryNetwork) -> None:
    learners = [ScriptedLearner(network, run=run) for run in ("two", "one")]
    of_another_version = MemoryTransport(network)
    of_another_version.serve(keys.join("three", "*"), lambda request: request.reply(of_another_release()))
    actor = RunningActor(network, run="cartpol")
    until(lambda: "waiting for a learner of run 'cartpol'; the runs here are 'one', 'two'" in LINES)
    actor.stop.set()
    actor.join()
    actor = RunningActor(network, run="cartpol", timeout=0.05)
    actor.join()
    assert str(actor.error) == (
        "no learner answered within 0.05 s: waited for a learner of run 'cartpol'; the runs here are 'one', 'two'; "
        "choose with --run"
    )
    assert all(learner.joins.get(timeout=LIMIT).spaces is None for learner in learners)


@pytest.mark.parametrize("any_run", [False, True])
def test_actor_stays_with_the_run_that_it_joined_first_unless_told_otherwise(
    network: MemoryNetwork, any_run: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(learner_queries, "_LOOK_AROUND_SECONDS", 0.1)
    first = ScriptedLearner(network, run="first")
    actor = RunningActor(network, any_run=any_run)
    first.publish(0)
    first.receive()
    other = ScriptedLearner(network, run="other", epoch=2)
    other.publish(0)
    first.transport.close()
    if any_run:
        assert other.receive()[0].identity.learner_epoch == 2
    else:
        until(lambda: "waiting for a learner of run 'first'; the runs here are 'other'" in LINES)
        again = ScriptedLearner(network, run="first", epoch=3)
        again.publish(0)
        assert again.receive()[0].identity.learner_epoch == 3
        assert other.rollouts.empty()
    actor.stop.set()
    actor.join()


def test_actor_ends_after_its_timeout_without_a_learner(network: MemoryNetwork) -> None:
    actor = RunningActor(network, timeout=0.05)
    actor.join()
    assert "no learner answered within 0.05 s" in str(actor.error)


def test_quarantine_ends_the_actor_with_the_reason(network: MemoryNetwork) -> None:
    learner = ScriptedLearner(network)
    actor = RunningActor(network)
    learner.publish(0)
    _, request = learner.receive()
    request.reply(encode(Acknowledgement(verdict="quarantined", reason="3 unfit rollouts in a row")))
    actor.join()
    assert isinstance(actor.error, ActorError)
    assert "quarantined this actor: 3 unfit rollouts in a row" in str(actor.error)
    assert not any(join.failure for join in learner.joins.queue)  # the learner knows the reason


def test_consecutive_rejections_are_warned_of_once_with_the_reason(network: MemoryNetwork, actor: RunningActor) -> None:
    learner = ScriptedLearner(network)
    learner.publish(0)
    for count in range(60):
        _, request = learner.receive()
        if count < 15:
            acknowledge(request, "rejected" if count else "accepted")
        else:
            request.reply(encode(Acknowledgement(verdict="rejected", reason="policy lag 31, at most 30 is allowed")))
        if count < 15:
            assert not any("rejected" in line for line in LINES)
    (warning,) = [line for line in LINES if "rejected the last" in line]
    assert "policy lag 31, at most 30 is allowed" in warning
    assert "max_policy_lag" in warning


def test_actor_probes_a_silent_learner_and_rejoins_if_it_does_not_respond(
    network: MemoryNetwork, actor: RunningActor, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(session_monitor, "_SILENCE_SECONDS", 0.1)
    learner = ScriptedLearner(network)
    learner.publish(0)
    held = [learner.receive(), learner.receive()]  # never answered
    assert learner.joins.get(timeout=LIMIT).spaces is None
    assert learner.joins.get(timeout=LIMIT).spaces == SPACES
    for _ in range(3):
        assert learner.joins.get(timeout=LIMIT).spaces is None  # the probe is answered: the learner is only slow
    assert not any("went away" in text for text in LINES)
    learner.transport.serve(keys.join("r", "*"), lambda request: request.reply(b""))  # no valid message
    until(lambda: any("went away" in text for text in LINES))
    learner.transport.serve(keys.join("r", "*"), learner._join)
    again = learner.receive()
    assert again[0].identity in [rollout.identity for rollout, _ in held]  # the same rollout again


def test_actor_reopens_its_transport_while_nobody_answers(
    network: MemoryNetwork, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(learner_queries, "_REOPEN_SECONDS", 0.0)
    reopened = threading.Semaphore(0)

    def reopen(transport: MemoryTransport) -> bool:
        reopened.release()
        raise TransportError("nothing answers there")

    monkeypatch.setattr(MemoryTransport, "reopen", reopen)
    actor = RunningActor(network)
    for _ in range(3):
        assert reopened.acquire(timeout=LIMIT)
    learner = ScriptedLearner(network)
    learner.publish(0)
    learner.receive()
    actor.stop.set()
    actor.join()
    assert actor.error is None


def test_actor_that_is_stopped_while_its_transport_is_reopened_ends(
    network: MemoryNetwork, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(learner_queries, "_REOPEN_SECONDS", 0.0)
    reopening, ended = threading.Event(), threading.Event()

    def reopen(transport: MemoryTransport) -> bool:
        reopening.set()
        return ended.wait(LIMIT)

    monkeypatch.setattr(MemoryTransport, "reopen", reopen)
    actor = RunningActor(network)
    assert reopening.wait(LIMIT)
    actor.stop.set()
    actor.join()
    assert actor.error is None
    assert not ended.is_set()
    ended.set()


@pytest.mark.parametrize("stopped_in", ["join", "program"])
def test_an_actor_that_is_stopped_during_a_query_sends_no_other_query(
    network: MemoryNetwork, monkeypatch: pytest.MonkeyPatch, stopped_in: str
) -> None:
    """Each query may take 5 s, and a process has 5 s to end."""
    learner = ScriptedLearner(network)
    learner.publish(0)
    actor = RunningActor(network, begin=False)
    monkeypatch.setattr(runtime_maker, "_SLOW_LINK_SECONDS", -LIMIT)  # the link is measured by several queries
    query, sent = actor.transport.query, list[str]()

    def stopping_query(key: str, payload: bytes = b"", *, timeout: float) -> list[bytes]:
        sent.append(key)
        if f"/{stopped_in}" in key:
            actor.stop.set()
        return query(key, payload, timeout=timeout)

    monkeypatch.setattr(actor.transport, "query", stopping_query)
    actor.begin()
    actor.join()
    assert actor.error is None
    assert [f"/{stopped_in}" in key for key in sent].count(True) == 1
    assert f"/{stopped_in}" in sent[-1]
