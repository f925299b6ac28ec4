"""ActorService against a scripted learner, over the memory transport."""

import queue
import threading
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import pytest
from log_lines import LINES
from processes import LIMIT, until

from daedalus.actor.collecting.collector import Collector
from daedalus.actor.collecting.environment_collector import EnvironmentCollector
from daedalus.actor.session import learner_queries, service, session_monitor
from daedalus.actor.session.learner_queries import ActorError
from daedalus.actor.session.service import ActorConfig, ActorService, LinkChoice
from daedalus.learner.serving.compact_snapshot_cache import CompactSnapshotCache
from daedalus.policy.acting.program import export_program
from daedalus.policy.acting.runtime import program_hash
from daedalus.policy.network.actor_critic import ActorCritic
from daedalus.protocol import keys
from daedalus.protocol.codec import decode, encode
from daedalus.protocol.limits import Limits
from daedalus.protocol.messages import (
    Acknowledgement,
    Join,
    Message,
    Program,
    Refusal,
    Rollout,
    RolloutIdentity,
    RunEnded,
    Snapshot,
    SnapshotRequest,
    Welcome,
)
from daedalus.protocol.spaces import ArraySpace, DiscreteSpace, Spaces
from daedalus.protocol.spec import PolicySpec, RunSpec
from daedalus.transport.interface import Request, TransportError
from daedalus.transport.memory import MemoryNetwork, MemoryTransport

SPEC = RunSpec.model_validate(
    {"environment": {"id": "CartPole-v1"}, "collection": {"envs_per_actor": 2, "rollout_length": 4, "window": 2}}
)
SPACES = Spaces(observation=ArraySpace(shape=(4,), dtype="float32"), action=DiscreteSpace(count=2))


@dataclass(frozen=True)
class Policy:
    """A network and the program that a learner would send."""

    network: ActorCritic
    model: bytes

    @classmethod
    def of(cls, spec: PolicySpec, spaces: Spaces) -> "Policy":
        network = ActorCritic(spec, spaces)
        return cls(network, export_program(network, spaces.observation))


POLICY = Policy.of(PolicySpec(), SPACES)


class ScriptedLearner:
    """A learner that answers joins and programs, and leaves every rollout to the test to acknowledge."""

    def __init__(self, network: MemoryNetwork, spec: RunSpec = SPEC, epoch: int = 1, policy: Policy = POLICY) -> None:
        self.transport = MemoryTransport(network)
        self.epoch, self.spec, self.policy = epoch, spec, policy
        self.joins: queue.Queue[Join] = queue.Queue()
        self.rollouts: queue.Queue[Request] = queue.Queue()
        self.snapshot: bytes = encode(Refusal(code="not_ready", reason=""))
        self.refusal: Refusal | None = None
        self.transport.declare_presence(keys.learner("r"))
        self.transport.serve(keys.rollouts("r", "*"), self.rollouts.put)
        self.transport.serve(keys.snapshots("r"), self._newest)
        self.transport.serve(keys.program("r", "*"), self._program)
        self.transport.serve(keys.join("r"), self._join)

    def _join(self, request: Request) -> None:
        message = decode(request.payload, Limits())
        assert isinstance(message, Join)
        self.joins.put(message)
        answer: Message = Welcome(run="r", learner_epoch=self.epoch, seed=1, spec=self.spec)
        request.reply(encode(self.refusal or answer))

    def _newest(self, request: Request) -> None:
        if not request.size:
            request.reply(self.snapshot)
            return
        message = decode(request.payload, Limits())
        assert isinstance(message, SnapshotRequest)
        request.reply(CompactSnapshotCache(self.epoch).answer(message, self.snapshot))

    def _program(self, request: Request) -> None:
        model = self.policy.model
        request.reply(encode(Program(hash=program_hash(model), model=np.frombuffer(model, np.uint8))))

    def publish(self, version: int, *, push: bool = True) -> None:
        weights = {name: parameter.detach().numpy() for name, parameter in self.policy.network.named_parameters()}
        name = program_hash(self.policy.model)
        self.snapshot = encode(
            Snapshot(learner_epoch=self.epoch, policy_version=version, program=name, weights=weights)
        )
        if push:
            self.transport.publish(keys.snapshots("r"), self.snapshot)

    def receive(self) -> tuple[Rollout, Request]:
        request = self.rollouts.get(timeout=LIMIT)
        rollout = decode(request.payload, Limits())
        assert isinstance(rollout, Rollout)
        return rollout, request


def acknowledge(request: Request, verdict: str, version: int = 0) -> None:
    request.reply(encode(Acknowledgement(verdict=verdict, policy_version=version)))  # type: ignore[arg-type] - one of its literals


class RunningActor:
    def __init__(
        self,
        network: MemoryNetwork,
        timeout: float | None = None,
        link: LinkChoice = "auto",
        collector: Collector | None = None,
    ) -> None:
        self.stop = threading.Event()
        self.error: Exception | None = None
        self.transport = MemoryTransport(network)
        config = ActorConfig(name="a", incarnation=7, timeout=timeout, link=link)
        self._service = ActorService(config, self.transport, self.stop, collector)
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def _run(self) -> None:
        try:
            self._service.run()
        except Exception as error:
            self.error = error

    def join(self) -> None:
        self._thread.join(LIMIT)
        assert not self._thread.is_alive()


@pytest.fixture
def network() -> MemoryNetwork:
    return MemoryNetwork()


@pytest.fixture
def actor(network: MemoryNetwork) -> Iterator[RunningActor]:
    running = RunningActor(network)
    yield running
    running.stop.set()
    running.join()


def test_actor_joins_without_spaces_and_then_with_them(network: MemoryNetwork) -> None:
    learner = ScriptedLearner(network)
    actor = RunningActor(network)
    asked, counted_in = learner.joins.get(timeout=LIMIT), learner.joins.get(timeout=LIMIT)
    assert asked.spaces is None
    assert (counted_in.spaces, counted_in.environments) == (SPACES, 2)
    actor.stop.set()
    actor.join()
    assert actor.error is None


def test_actor_keeps_a_window_of_numbered_rollouts_in_flight(network: MemoryNetwork, actor: RunningActor) -> None:
    learner = ScriptedLearner(network)
    learner.publish(3)
    first, second = learner.receive(), learner.receive()
    assert [first[0].identity.sequence, second[0].identity.sequence] == [0, 1]
    assert first[0].policy_version == 3
    assert learner.rollouts.empty()  # two are not acknowledged: there is no third, however long this test takes
    acknowledge(first[1], "accepted")
    assert learner.receive()[0].identity.sequence == 2


def test_window_is_larger_on_a_slow_link_before_the_first_acknowledgement(network: MemoryNetwork) -> None:
    actor = RunningActor(network, link="wan")
    learner = ScriptedLearner(network)
    learner.publish(3)
    received = [learner.receive()[0] for _ in range(service._SLOW_LINK_WINDOW)]
    assert [rollout.policy_version for rollout in received] == [3] * len(received)
    assert learner.rollouts.empty()
    actor.stop.set()
    actor.join()


def test_actor_never_subscribes_on_a_link_measured_as_slow(
    network: MemoryNetwork, monkeypatch: pytest.MonkeyPatch
) -> None:
    followed: list[object] = []
    monkeypatch.setattr(MemoryTransport, "subscribe", lambda *arguments: followed.append(arguments))
    monkeypatch.setattr(service, "_SLOW_LINK_SECONDS", -LIMIT)
    learner = ScriptedLearner(network)
    learner.publish(3)
    actor = RunningActor(network)
    assert learner.receive()[0].policy_version == 3
    assert any(text.startswith("slow link: ") for text in LINES)
    assert followed == []
    actor.stop.set()
    actor.join()


def test_rollout_after_a_wait_is_of_the_newest_policy(network: MemoryNetwork, actor: RunningActor) -> None:
    learner = ScriptedLearner(network)
    learner.publish(3)
    first, second = learner.receive(), learner.receive()
    learner.publish(4)  # while the window is full
    acknowledge(first[1], "accepted")
    assert [second[0].policy_version, learner.receive()[0].policy_version] == [3, 4]


def test_frame_stack_and_memory_follow_the_run(network: MemoryNetwork) -> None:
    policy = PolicySpec(hidden=(8,), memory="gru", memory_units=5)
    environment = SPEC.environment.model_copy(update={"frame_stack": 3})
    spec = SPEC.model_copy(update={"environment": environment, "policy": policy})
    spaces = SPACES.model_copy(update={"observation": SPACES.observation.model_copy(update={"frames": 3})})
    learner = ScriptedLearner(network, spec, policy=Policy.of(policy, spaces))
    actor = RunningActor(network)
    learner.publish(0)
    received = []
    for _ in range(2):
        rollout, request = learner.receive()
        acknowledge(request, "accepted")
        received.append(rollout)
    actor.stop.set()
    actor.join()
    assert actor.error is None
    assert [learner.joins.get(timeout=LIMIT).spaces for _ in range(2)] == [None, spaces]
    first, second = received
    assert first.frames.shape == second.frames.shape == (3 + 4, 2, 4)
    np.testing.assert_array_equal(first.frames[4:], second.frames[:3])
    assert first.initial_state.shape == (2, 5)
    assert not first.initial_state.any()
    assert second.initial_state.any()


def test_busy_rollout_is_sent_again(network: MemoryNetwork, actor: RunningActor) -> None:
    learner = ScriptedLearner(network)
    learner.publish(0)
    rollout, request = learner.receive()
    assert learner.receive()[0].identity.sequence == 1
    acknowledge(request, "busy")
    again, _ = learner.receive()
    assert again.identity == rollout.identity
    np.testing.assert_array_equal(again.frames, rollout.frames)


def test_actor_collects_with_the_newest_snapshot(network: MemoryNetwork, actor: RunningActor) -> None:
    learner = ScriptedLearner(network)
    learner.publish(0)
    versions = []
    for version in (5, 6, 7, 8):
        rollout, request = learner.receive()
        versions.append(rollout.policy_version)
        learner.publish(version)
        acknowledge(request, "accepted", version)
    assert versions[0] == 0
    assert versions == sorted(versions)
    assert versions[-1] >= 5


class SlowClient(EnvironmentCollector):
    """A collector whose rollouts are complete only after weights of version 1 came."""

    def has_rollout(self) -> bool:
        return self._policy_version >= 1

    def collect(self, identity: RolloutIdentity) -> Rollout | None:  # type: ignore[override] - as Collector has it
        return super().collect(identity) if self.has_rollout() else None


def test_newer_weights_are_loaded_while_a_rollout_is_incomplete(network: MemoryNetwork) -> None:
    learner = ScriptedLearner(network)
    learner.publish(0)
    actor = RunningActor(network, collector=SlowClient())
    until(lambda: any("joined run" in text for text in LINES))
    assert learner.rollouts.empty()
    learner.publish(1)
    assert learner.receive()[0].policy_version == 1
    actor.stop.set()
    actor.join()
    assert actor.error is None


def test_acknowledgement_is_received_while_a_snapshot_is_decoded(
    network: MemoryNetwork, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Decoding megabytes must not hold the lock that the transport's threads need."""
    decoding, released = threading.Event(), threading.Event()

    def slow_decode(data: bytes, limits: Limits) -> Message:
        message = decode(data, limits)
        if isinstance(message, Snapshot) and message.policy_version == 1:
            decoding.set()
            assert released.wait(LIMIT)
        return message

    spec = SPEC.model_copy(update={"training": SPEC.training.model_copy(update={"algorithm": "a2c"})})
    learner = ScriptedLearner(network, spec)
    actor = RunningActor(network)
    learner.publish(0)
    _, request = learner.receive()
    monkeypatch.setattr(learner_queries, "decode", slow_decode)
    try:
        learner.publish(1)
        assert decoding.wait(LIMIT)
        answering = threading.Thread(target=acknowledge, args=(request, "accepted", 1), daemon=True)
        answering.start()
        answering.join(5.0)
        assert not answering.is_alive(), "the transport's thread waited for the decoder"
    finally:
        released.set()
    assert learner.receive()[0].policy_version == 1
    actor.stop.set()
    actor.join()
    assert actor.error is None


def test_actor_requests_a_snapshot_whose_push_was_lost(network: MemoryNetwork, actor: RunningActor) -> None:
    learner = ScriptedLearner(network)
    learner.publish(0)
    rollout, request = learner.receive()
    learner.publish(1, push=False)
    while rollout.policy_version == 0:
        acknowledge(request, "accepted", 1)
        rollout, request = learner.receive()
    assert rollout.policy_version == 1


def test_actor_fenced_by_the_same_learner_epoch_continues_its_sequence(
    network: MemoryNetwork, actor: RunningActor
) -> None:
    learner = ScriptedLearner(network)
    learner.publish(0)
    _, request = learner.receive()
    acknowledge(request, "rejected")
    _, request = learner.receive()
    acknowledge(request, "fenced")
    sequences = []
    for _ in range(3):
        rollout, request = learner.receive()
        acknowledge(request, "accepted")
        sequences.append(rollout.identity.sequence)
    assert sequences[-1] >= 3  # the learner knows the earlier ones


def test_synchronous_actor_requests_the_next_version_if_its_push_was_lost(network: MemoryNetwork) -> None:
    spec = SPEC.model_copy(update={"training": SPEC.training.model_copy(update={"algorithm": "a2c"})})
    learner = ScriptedLearner(network, spec)
    actor = RunningActor(network)
    learner.publish(0)
    _, request = learner.receive()
    learner.publish(1, push=False)
    acknowledge(request, "accepted", 1)
    assert learner.receive()[0].policy_version == 1
    actor.stop.set()
    actor.join()


def test_synchronous_actor_replaces_a_rejected_rollout_under_the_same_version(network: MemoryNetwork) -> None:
    spec = SPEC.model_copy(update={"training": SPEC.training.model_copy(update={"algorithm": "a2c"})})
    learner = ScriptedLearner(network, spec)
    actor = RunningActor(network)
    learner.publish(0)
    _, request = learner.receive()
    acknowledge(request, "rejected")
    again, _ = learner.receive()
    assert (again.identity.sequence, again.policy_version) == (1, 0)
    actor.stop.set()
    actor.join()


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
        learner.transport.publish(keys.snapshots("r"), encode(RunEnded(learner_epoch=1, reason="solved")))
        acknowledge(request, "accepted")
    else:
        acknowledge(request, "finished")
    actor.join()
    assert actor.error is None
    assert LINES[-1].startswith("the run is over")


def test_damaged_message_is_logged_and_ignored(network: MemoryNetwork, actor: RunningActor) -> None:
    learner = ScriptedLearner(network)
    learner.publish(0)
    _, request = learner.receive()
    learner.transport.publish(keys.snapshots("r"), b"\xff" * 100)
    acknowledge(request, "accepted")
    _, request = learner.receive()
    acknowledge(request, "accepted")
    learner.receive()
    assert any("ignored a damaged message" in text for text in LINES)


def test_refusal_ends_the_actor_with_the_reason(network: MemoryNetwork) -> None:
    learner = ScriptedLearner(network)
    learner.refusal = Refusal(code="mismatch", reason="its environment has 3 choices")
    actor = RunningActor(network)
    actor.join()
    assert isinstance(actor.error, ActorError)
    assert "its environment has 3 choices" in str(actor.error)


def test_two_learners_require_a_choice(network: MemoryNetwork) -> None:
    for run in ("one", "two"):
        transport = MemoryTransport(network)
        welcome = encode(Welcome(run=run, learner_epoch=1, seed=1, spec=SPEC))
        transport.serve(keys.join(run), lambda request, welcome=welcome: request.reply(welcome))
    actor = RunningActor(network)
    actor.join()
    assert "several learners answer here (one, two): choose one with --run" in str(actor.error)


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
    learner.transport.serve(keys.join("r"), lambda request: request.reply(b""))  # no valid message
    until(lambda: any("went away" in text for text in LINES))
    learner.transport.serve(keys.join("r"), learner._join)
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
