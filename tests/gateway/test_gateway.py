"""The gateway over MemoryTransport: clients play, and their rollouts reach a learner."""

from collections.abc import Iterator

import pytest
from gateways import JsonClient, RunningGateway
from scripted_learner import ScriptedLearner, acknowledge

from daedalus.transport.memory import MemoryNetwork, MemoryTransport

OBSERVATION = [0.0, 0.1, 0.2, 0.3]


@pytest.fixture
def network() -> MemoryNetwork:
    return MemoryNetwork()


@pytest.fixture
def learner(network: MemoryNetwork) -> Iterator[ScriptedLearner]:
    learner = ScriptedLearner(network)
    learner.publish(0)
    yield learner
    learner.transport.close()


@pytest.fixture
def gateway(network: MemoryNetwork, learner: ScriptedLearner) -> Iterator[RunningGateway]:
    running = RunningGateway(MemoryTransport(network))
    yield running
    running.close()
    assert running.failure is None


def test_rollouts_of_a_client_reach_the_learner_under_its_name(
    gateway: RunningGateway, learner: ScriptedLearner
) -> None:
    client = JsonClient(gateway.port)
    welcome = client.hello("arm-1")
    assert welcome == {"type": "welcome", "version": 1, "run": "r", "environment": "CartPole-v1", "name": "arm-1"}
    actions = []
    for step in range(5):  # a rollout of 4 rows ends with a fifth observation
        answer = client.act([float(step), 0.0, 0.0, 0.0])
        assert answer["type"] == "action"
        actions.append(answer["action"])
        client.send("reward", reward=1.5)
        client.send("reward", reward=0.5)
    rollout, request = learner.receive()
    assert rollout.identity.actor == "arm-1"
    assert rollout.identity.sequence == 0
    assert rollout.frames["observation"][:, 0, 0].tolist() == [0.0, 1.0, 2.0, 3.0, 4.0]
    assert rollout.actions["action"][:, 0, 0].tolist() == actions[:4]
    assert rollout.rewards.tolist() == [[2.0]] * 4
    acknowledge(request, "accepted")
    client.close()
