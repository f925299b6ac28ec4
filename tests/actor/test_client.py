"""Client: what its own thread reports to the caller's thread."""

import math
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
from log_lines import LINES
from processes import LIMIT, until
from scripted_learner import ScriptedLearner, acknowledge

from daedalus.actor import Client
from daedalus.actor import client as client_module
from daedalus.actor.collecting.client_collector import ClientCollector
from daedalus.actor.collecting.loop_recorder import LoopRecorder
from daedalus.actor.environments.minari_files import DatasetError, MinariReader
from daedalus.actor.errors import ActorError
from daedalus.protocol.codec import encode
from daedalus.protocol.messages import Acknowledgement, ClientReport, Refusal
from daedalus.transport.memory import MemoryNetwork, MemoryTransport

OBSERVATION = np.zeros(4, np.float32)
SPACES = {
    "observation_space": gymnasium.spaces.Box(-np.inf, np.inf, (4,), np.float32),
    "action_space": gymnasium.spaces.Discrete(2),
}


@pytest.fixture
def learner(network: MemoryNetwork, monkeypatch: pytest.MonkeyPatch) -> Iterator[ScriptedLearner]:
    """A learner with a policy; clients connect to it whatever their address."""
    monkeypatch.setattr(client_module, "connect_with_retry", lambda *_: MemoryTransport(network))
    learner = ScriptedLearner(network)
    learner.publish(0)
    yield learner
    learner.transport.close()


def fill_rollout(client: Client) -> None:
    for _ in range(5):  # a rollout of 4 rows ends with a fifth observation
        client.act(OBSERVATION)


def test_client_rollouts_reach_the_learner(learner: ScriptedLearner) -> None:
    with Client("tcp/127.0.0.1:1", **SPACES, name="robot") as client:
        fill_rollout(client)
        rollout, _ = learner.receive()
        assert (rollout.identity.actor, rollout.policy_version) == ("robot", 0)
        assert not client.is_over


def test_client_records_what_is_played(learner: ScriptedLearner, tmp_path: Path) -> None:
    place = tmp_path / "played"
    observation = np.zeros(4, np.float32)
    with Client("tcp/127.0.0.1:1", **SPACES, record=place) as client:
        played = []
        for step in range(3):
            observation[0] = step  # a loop may use its arrays again
            played.append(client.act(observation, override=1 if step == 1 else None))
            client.reward(float(step))
        client.end_episode(terminated=False, observation=observation + 1.0)
        client.reward(0.5)  # late: of the last action
        client.act(observation, override=7)  # no action of the space
        client.success()
        client.act(observation)
        client.success()
        client.act(observation)  # its episode has no end
    with MinariReader(str(place)) as dataset:
        first, second = list(dataset)
    np.testing.assert_array_equal(first.observations[:, 0], [0.0, 1.0, 2.0, 3.0])
    np.testing.assert_array_equal(first.actions, played)
    np.testing.assert_array_equal(first.rewards, [0.0, 1.0, 2.5])
    assert (first.terminated, first.truncated, second.terminated) == (False, True, True)
    np.testing.assert_array_equal(second.rewards, [1.0])
    np.testing.assert_array_equal(second.observations[:, 0], [2.0, 2.0])  # nothing follows a termination
    with pytest.raises(DatasetError, match="exists at"):
        Client("tcp/127.0.0.1:1", **SPACES, record=place)
    with pytest.raises(DatasetError, match=r"cannot be written: .*Not a directory"):
        Client("tcp/127.0.0.1:1", **SPACES, record=place / "data/metadata.json/below")


def test_an_episode_that_lacks_a_part_of_an_action_is_not_recorded(tmp_path: Path) -> None:
    turn = gymnasium.spaces.Box(-1.0, 1.0, (1,))
    tape = LoopRecorder(str(tmp_path / "played")).tape(turn, gymnasium.spaces.Dict({"arm": turn, "hand": turn}))
    tape.act(np.zeros(1, np.float32), {"arm": np.zeros(1, np.float32)})
    tape.end(None, terminated=True)
    tape.finish()
    assert "not recorded: an observation or an action that was played lacks 'hand';" in LINES[-1]


def test_client_may_wait_for_ever(learner: ScriptedLearner) -> None:
    with Client("tcp/127.0.0.1:1", **SPACES, timeout=math.inf) as client:
        assert client.act(OBSERVATION) in SPACES["action_space"]


def test_act_raises_the_quarantine_that_ended_the_client(learner: ScriptedLearner) -> None:
    with Client("tcp/127.0.0.1:1", **SPACES) as client:
        fill_rollout(client)
        learner.receive()[1].reply(encode(Acknowledgement(verdict="quarantined", reason="why")))
        until(lambda: not client._thread.is_alive())
        assert not client.is_over, "a loop that ends with the run would hide the error"
        with pytest.raises(ActorError, match="quarantined this actor: why"):
            client.act(OBSERVATION)


def test_act_raises_a_bug_of_the_clients_thread(learner: ScriptedLearner, monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(*_: object) -> None:
        raise ZeroDivisionError("a bug")

    with Client("tcp/127.0.0.1:1", **SPACES) as client:
        monkeypatch.setattr(ClientCollector, "collect", fail)
        fill_rollout(client)
        until(lambda: not client._thread.is_alive())
        with pytest.raises(ZeroDivisionError, match="a bug"):
            client.act(OBSERVATION)


class InterruptedEvent(threading.Event):
    """An event whose wait ends with Ctrl-C."""

    def wait(self, timeout: float | None = None) -> bool:
        raise KeyboardInterrupt


def test_ctrl_c_while_waiting_for_a_policy_closes_the_session(
    network: MemoryNetwork, learner: ScriptedLearner, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A process that ends with an open Zenoh session aborts."""
    learner.snapshot = encode(Refusal(code="not_ready", reason=""))
    construct = ClientCollector.__init__

    def construct_interrupted(collector: ClientCollector, *arguments: Any, **options: Any) -> None:
        construct(collector, *arguments, **options)
        collector.policy_loaded = InterruptedEvent()

    monkeypatch.setattr(ClientCollector, "__init__", construct_interrupted)
    with pytest.raises(KeyboardInterrupt):
        Client("tcp/127.0.0.1:1", **SPACES)
    assert network.ends == [learner.transport]
    assert "actor" not in {thread.name for thread in threading.enumerate()}


def test_reason_why_nobody_lets_the_client_join_is_raised(learner: ScriptedLearner) -> None:
    """The client's thread notices the end of `timeout` when it asks again, a moment later than the caller's."""
    learner.refusal = Refusal(code="name_taken", reason="actor name 'robot' is already in use")
    with pytest.raises(ActorError, match="actor name 'robot' is already in use"):
        Client("tcp/127.0.0.1:1", **SPACES, name="robot", timeout=1.0)


@pytest.mark.parametrize(
    ("name", "value", "reason"),
    [
        ("agents", "2", "agents is '2': it must be from 1 to 4096"),
        ("link", "slow", "link is 'slow': choose from auto, lan, wan"),
        ("timeout", None, "timeout is None: it must be a number of seconds above 0"),
        ("timeout", "5", "timeout is '5'"),
        ("timeout", float("nan"), "timeout is nan"),
    ],
)
def test_arguments_without_a_meaning_are_refused(name: str, value: Any, reason: str) -> None:
    with pytest.raises(ValueError, match=reason):
        Client("tcp/127.0.0.1:1", **SPACES, **{name: value})


def test_numbers_of_numpy_are_numbers(learner: ScriptedLearner) -> None:
    learner.refusal = Refusal(code="finished", reason="the run is over")
    with pytest.raises(ActorError, match="the run ended before a policy came"):
        Client("tcp/127.0.0.1:1", **SPACES, agents=np.int64(2), timeout=np.float32(30.0))  # pyright: ignore[reportArgumentType]  # on purpose


def test_run_that_is_over_has_no_client(learner: ScriptedLearner) -> None:
    learner.refusal = Refusal(code="finished", reason="the run is over")
    with pytest.raises(ActorError, match="the run ended before a policy came"):
        Client("tcp/127.0.0.1:1", **SPACES)


def acts_until(client: Client, condition: Callable[[], bool]) -> None:
    """Run the loop until a condition holds."""

    def acted() -> bool:
        client.act(OBSERVATION)
        return condition()

    until(acted)


def test_safe_action_while_the_learner_is_gone_and_recovery(network: MemoryNetwork, learner: ScriptedLearner) -> None:
    learner.publish(3)
    with Client("tcp/127.0.0.1:1", **SPACES, name="robot", safe_action=1, max_policy_age=0.5) as client:
        acts_until(client, lambda: bool(learner.fetches))  # it asks for confirmation although no rollout is due
        learner.transport.close()
        acts_until(client, lambda: "did not confirm the policy within 0.5 s" in client.safe_reason)
        assert [client.act(OBSERVATION) for _ in range(20)] == [1] * 20
        back = ScriptedLearner(network, epoch=2)
        back.publish(4)
        acts_until(client, lambda: client.safe_reason == "")
        acts_until(client, lambda: not back.rollouts.empty())
        rollout, _ = back.receive()
        assert (rollout.policy_version, rollout.identity.learner_epoch, rollout.overridden) == (4, 2, None)
        assert client.dropped > 0
        back.transport.close()


def test_client_waits_for_its_learner_longer_than_for_the_first_one(
    network: MemoryNetwork, learner: ScriptedLearner
) -> None:
    learner.publish(3)
    with Client("tcp/127.0.0.1:1", **SPACES, timeout=3.0, safe_action=1, max_policy_age=0.5) as client:
        acts_until(client, lambda: client.safe_reason == "")
        learner.transport.close()
        gone = time.monotonic()
        acts_until(client, lambda: time.monotonic() > gone + 8.0)
        assert not client.is_over
        assert client.safe_reason
        back = ScriptedLearner(network, epoch=2)
        back.publish(4)
        acts_until(client, lambda: client.safe_reason == "")
        back.transport.close()


def test_policy_does_not_age_while_the_learner_confirms_it(learner: ScriptedLearner) -> None:
    """A learner that has no newer policy, such as while all robots play the safe action, is not one that is gone."""
    learner.publish(3)
    with Client("tcp/127.0.0.1:1", **SPACES, name="robot", safe_action=1, max_policy_age=2.0) as client:
        learner.snapshot = encode(Refusal(code="not_ready", reason="the actor holds the newest snapshot"))
        seen = len(learner.fetches)
        for _ in range(2):
            fill_rollout(client)  # nobody acknowledges them: the window stays full
        until(lambda: len(learner.fetches) > seen + 8)  # two seconds and more
        client.act(OBSERVATION)
        assert client.safe_reason == ""


def test_acting_goes_on_while_the_learner_acknowledges_nothing(learner: ScriptedLearner) -> None:
    with Client("tcp/127.0.0.1:1", **SPACES, name="robot") as client:
        acts_until(client, lambda: client.dropped > 3)
        assert learner.rollouts.qsize() <= 2  # the window
        report = learner.reports.get(timeout=LIMIT)
        while not report.rollouts_dropped:
            report = learner.reports.get(timeout=LIMIT)


def test_client_reports_what_it_counts(learner: ScriptedLearner) -> None:
    with Client("tcp/127.0.0.1:1", **SPACES, name="robot", safe_action=1) as client:
        with client.clock(rate=1000.0) as clock:
            for _ in range(3):
                assert clock.wait()
                client.act(OBSERVATION)  # of version 0
        client.act(OBSERVATION, override=0)
        report = learner.reports.get(timeout=LIMIT)
        while not report.overridden_actions:
            report = learner.reports.get(timeout=LIMIT)
        missed = clock.missed_deadlines
        assert report == ClientReport(
            actor="robot",
            incarnation=report.incarnation,
            rows=4,
            rollout_seconds=report.rollout_seconds,
            round_trip_seconds=report.round_trip_seconds,
            processor_share=report.processor_share,
            memory_bytes=report.memory_bytes,
            deadlines=2 + missed,
            missed_deadlines=missed,
            overridden_actions=1,
            safe_actions=3,
            safe_reason="no update has changed the policy yet: pass untrained=True to let it act",
        )


def test_clients_of_one_process_have_names_of_their_own(learner: ScriptedLearner) -> None:
    """A loop with several agents or environments has a client for each of them."""
    with Client("tcp/127.0.0.1:1", **SPACES) as left, Client("tcp/127.0.0.1:1", **SPACES) as right:
        senders = set()
        for _ in range(5):
            left.act(OBSERVATION)
            right.act(OBSERVATION)
        for _ in range(2):
            rollout, request = learner.receive()
            acknowledge(request, "accepted")
            senders.add(rollout.identity.actor)
        assert len(senders) == 2


def test_client_takes_part_in_a_synchronous_run(network: MemoryNetwork, learner: ScriptedLearner) -> None:
    """It acts on while the learner makes an update, and begins its next rollout with the new policy."""
    learner.spec = learner.spec.model_copy(
        update={"training": learner.spec.training.model_copy(update={"algorithm": "a2c"})}
    )
    with Client("tcp/127.0.0.1:1", **SPACES) as client:
        for version in range(3):
            acts_until(client, lambda: not learner.rollouts.empty())
            rollout, request = learner.receive()
            assert rollout.policy_version == version
            for _ in range(20):
                client.act(OBSERVATION)
            assert learner.rollouts.empty(), "the next rollout waits for the update"
            learner.publish(version + 1)
            acknowledge(request, "accepted", version + 1)
        assert client.dropped == 0
