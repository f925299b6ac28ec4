"""Clients of the gateway explore with the epsilons of their own Welcomes, also where one call chooses for several."""

import math

import numpy as np
from gateways import JsonClient, RunningGateway
from scripted_learner import SPACES, Policy, ScriptedLearner

from daedalus.protocol.spec import PolicySpec, RunSpec
from daedalus.transport.memory import MemoryNetwork

SPEC = RunSpec.model_validate(
    {
        "environment": {"id": "CartPole-v1"},
        "collection": {"rollout_length": 48},
        "training": {"algorithm": "n_step_q"},
    }
)
EPSILONS = {"careful": 0.0, "curious": 0.5}


def test_each_client_explores_with_its_own_epsilon(network: MemoryNetwork) -> None:
    learner = ScriptedLearner(network, SPEC, policy=Policy.of(PolicySpec(), SPACES, SPEC.training))
    learner.epsilons = EPSILONS
    learner.publish(0)
    gateway = RunningGateway(network)
    clients = {name: JsonClient(gateway.port) for name in EPSILONS}
    try:
        for name, client in clients.items():
            client.hello(name)
        for step in range(49):
            for client in clients.values():
                client.send("act", observation=[math.sin(step), 0.0, 0.1, 0.0])
            for client in clients.values():
                assert client.receive()["action"] in (0, 1)
        rollouts = {rollout.identity.actor: rollout for rollout, _ in (learner.receive(), learner.receive())}
    finally:
        for client in clients.values():
            client.close()
        gateway.close()
        learner.transport.close()
    assert (rollouts["careful"].behaviour_log_probs == 0.0).all()
    is_random = np.isclose(rollouts["curious"].behaviour_log_probs, math.log(0.25), atol=1e-5)
    is_greedy = np.isclose(rollouts["curious"].behaviour_log_probs, math.log(0.75), atol=1e-5)
    assert (is_random | is_greedy).all()
    assert 0 < is_random.mean() < 0.6
