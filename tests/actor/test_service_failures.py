"""ActorService against a scripted learner, over the memory transport: failures, refusals and the end of the run."""

import socket
import struct

import pytest
from log_lines import LINES
from processes import LIMIT, until
from scripted_learner import SPEC, RunningActor, ScriptedLearner, acknowledge

from daedalus.actor.collecting.environment_collector import EnvironmentCollector
from daedalus.actor.errors import ActorError
from daedalus.protocol import keys
from daedalus.protocol.codec import PROTOCOL_VERSION, encode
from daedalus.protocol.messages import Acknowledgement, Refusal, RunEnded, Welcome
from daedalus.protocol.releases import own_release
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


def test_drained_actor_ends(network: MemoryNetwork, actor: RunningActor) -> None:
    learner = ScriptedLearner(network)
    learner.publish(0)
    _, request = learner.receive()
    acknowledge(request, "drained")
    actor.join()
    assert actor.error is None
    assert LINES[-1] == "run 'r': drained by an operator: this actor leaves the run"


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
    assert LINES[-1].startswith("run 'r': the run is over")


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
    assert str(actor.error).endswith(f"release (daedalus-rl 9.9; this process has {own_release()})")
    assert [join.failure for join in learner.joins.queue] == ["", str(actor.error)]


def test_unexpected_error_is_reported_with_its_type(network: MemoryNetwork, monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(*_: object) -> None:
        raise ZeroDivisionError("a fault of a simulator")

    monkeypatch.setattr(EnvironmentCollector, "collect", fail)
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


def test_two_learners_require_a_choice(network: MemoryNetwork) -> None:
    for run in ("one", "two"):
        transport = MemoryTransport(network)
        welcome = encode(Welcome(run=run, learner_epoch=1, seed=1, spec=SPEC.for_actors()))
        transport.serve(keys.join(run, "*"), lambda request, welcome=welcome: request.reply(welcome))
    actor = RunningActor(network)
    actor.join()
    assert "several learners answer here (one, two): choose one with --run" in str(actor.error)


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
    actor.end()


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
    actor.end()
    actor = RunningActor(network, run="cartpol", timeout=0.05)
    actor.join()
    assert str(actor.error) == (
        "no learner answered within 0.05 s: waited for a learner of run 'cartpol'; the runs here are 'one', 'two'; "
        "choose with --run"
    )
    assert all(learner.joins.get(timeout=LIMIT).spaces is None for learner in learners)


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
