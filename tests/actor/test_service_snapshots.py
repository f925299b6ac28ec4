"""ActorService against a scripted learner, over the memory transport: which snapshots it collects with."""

import threading
import time
from collections.abc import Callable

import pytest
from log_lines import LINES
from processes import LIMIT, until
from scripted_learner import SYNCHRONOUS_SPEC, RunningActor, ScriptedLearner, acknowledge

from daedalus.actor.collecting.environment_collector import EnvironmentCollector
from daedalus.actor.session import conversation, session_engine
from daedalus.protocol import keys
from daedalus.protocol.codec import decode
from daedalus.protocol.limits import Limits
from daedalus.protocol.messages import Message, Snapshot
from daedalus.protocol.uploads import Rollout, RolloutIdentity
from daedalus.transport.memory import MemoryNetwork


def test_window_is_larger_on_a_slow_link_before_the_first_acknowledgement(network: MemoryNetwork) -> None:
    actor = RunningActor(network, link="wan")
    learner = ScriptedLearner(network)
    learner.publish(3)
    received = [learner.receive() for _ in range(session_engine._SLOW_LINK_WINDOW)]  # a dropped one is sent again
    assert [rollout.policy_version for rollout, _ in received] == [3] * len(received)
    assert [rollout.identity.sequence for rollout, _ in received] == list(range(len(received)))
    assert learner.rollouts.empty()
    actor.end()


def test_rollout_after_a_wait_is_of_the_newest_policy(network: MemoryNetwork, actor: RunningActor) -> None:
    learner = ScriptedLearner(network)
    learner.publish(3)
    first, second = learner.receive(), learner.receive()
    learner.publish(4)  # while the window is full
    time.sleep(1.0)  # the actor awaits the snapshot for as long as it has waited for room
    acknowledge(first[1], "accepted")
    assert [second[0].policy_version, learner.receive()[0].policy_version] == [3, 4]


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


def test_actor_fetches_its_snapshots_once_or_twice_for_a_rollout_and_is_pushed_none(
    network: MemoryNetwork, actor: RunningActor
) -> None:
    learner = ScriptedLearner(network)
    learner.publish(0)
    rollouts = 40
    played = []
    for version in range(1, rollouts + 1):
        rollout, request = learner.receive()
        played.append(rollout.policy_version)
        learner.publish(version)
        acknowledge(request, "accepted", version)
    assert played[-1] >= rollouts - 3  # two rollouts are in flight
    assert rollouts / 2 <= len(learner.fetches) <= 2 * rollouts + 2
    assert all(not fetch.compact and fetch.actor == "a" for fetch in learner.fetches)
    held = [fetch.held_version or 0 for fetch in learner.fetches]
    assert held == sorted(held)
    subscriptions = {inbox.key for inbox in actor.transport._inboxes} - {""}  # without those that were closed
    assert subscriptions == {keys.run_end("r")}


def test_actor_plays_with_its_snapshot_if_a_fetch_has_no_answer(network: MemoryNetwork, actor: RunningActor) -> None:
    learner = ScriptedLearner(network)
    learner.publish(3)
    _, request = learner.receive()
    learner.snapshot = b""
    acknowledge(request, "accepted", 4)
    rollout, request = learner.receive()
    assert rollout.policy_version == 3
    learner.publish(5)
    while rollout.policy_version < 5:
        acknowledge(request, "accepted", 5)
        rollout, request = learner.receive()


class SlowClient(EnvironmentCollector):
    """A collector whose rollouts are complete only after weights of version 1 came."""

    def collect(self, identity: RolloutIdentity, on_row: Callable[[], None]) -> Rollout | None:  # type: ignore[override] - as Collector has it
        return super().collect(identity, on_row) if self._policy_version >= 1 else None


def test_newer_weights_are_loaded_while_a_rollout_is_incomplete(network: MemoryNetwork) -> None:
    learner = ScriptedLearner(network)
    learner.publish(0)
    actor = RunningActor(network, collector=SlowClient())
    until(lambda: any("joined run" in text for text in LINES))
    assert learner.rollouts.empty()
    learner.publish(1)
    assert learner.receive()[0].policy_version == 1
    actor.end()


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

    learner = ScriptedLearner(network, SYNCHRONOUS_SPEC)
    actor = RunningActor(network)
    learner.publish(0)
    _, request = learner.receive()
    monkeypatch.setattr(conversation, "decode", slow_decode)
    try:
        learner.publish(1)
        assert decoding.wait(LIMIT)
        answering = threading.Thread(target=acknowledge, args=(request, "accepted", 1), daemon=True)
        answering.start()
        answering.join(LIMIT)
        assert not answering.is_alive(), "the transport's thread waited for the decoder"
    finally:
        released.set()
    assert learner.receive()[0].policy_version == 1
    actor.end()


def test_actor_requests_a_snapshot_whose_push_was_lost(network: MemoryNetwork, actor: RunningActor) -> None:
    learner = ScriptedLearner(network)
    learner.publish(0)
    rollout, request = learner.receive()
    learner.publish(1, push=False)
    while rollout.policy_version == 0:
        acknowledge(request, "accepted", 1)
        rollout, request = learner.receive()
    assert rollout.policy_version == 1


@pytest.mark.parametrize("verdict", ["accepted", "rejected"])
def test_synchronous_actor_requests_the_next_version_if_its_push_was_lost(network: MemoryNetwork, verdict: str) -> None:
    """Otherwise it would collect with the version that it has, for ever, and every rollout would be stale."""
    learner = ScriptedLearner(network, SYNCHRONOUS_SPEC)
    actor = RunningActor(network)
    learner.publish(0)
    _, request = learner.receive()
    learner.publish(1, push=False)
    acknowledge(request, verdict, 1)
    assert learner.receive()[0].policy_version == 1
    actor.end()
