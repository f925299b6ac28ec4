"""Client: what its own thread reports to the caller's thread."""

from collections.abc import Iterator

import gymnasium
import numpy as np
import pytest
from processes import until
from scripted_learner import ScriptedLearner

from daedalus.actor import Client
from daedalus.actor import client as client_module
from daedalus.actor.collecting.client_collector import ClientCollector
from daedalus.actor.session.learner_queries import ActorError
from daedalus.protocol.codec import encode
from daedalus.protocol.messages import Acknowledgement
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


def test_act_raises_the_quarantine_that_ended_the_client(learner: ScriptedLearner) -> None:
    with Client("tcp/127.0.0.1:1", **SPACES) as client:
        fill_rollout(client)
        learner.receive()[1].reply(encode(Acknowledgement(verdict="quarantined", reason="why")))
        until(lambda: client.is_over)
        with pytest.raises(ActorError, match="quarantined this actor: why"):
            client.act(OBSERVATION)


def test_act_raises_a_bug_of_the_clients_thread(learner: ScriptedLearner, monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(*_: object) -> None:
        raise ZeroDivisionError("a bug")

    with Client("tcp/127.0.0.1:1", **SPACES) as client:
        monkeypatch.setattr(ClientCollector, "collect", fail)
        fill_rollout(client)
        until(lambda: client.is_over)
        with pytest.raises(ZeroDivisionError, match="a bug"):
            client.act(OBSERVATION)
