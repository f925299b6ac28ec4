"""Actors explore with the epsilon of their Welcome, and record the log-probabilities of their behaviour policy."""

import math
import threading
from collections.abc import Iterator

import gymnasium
import numpy as np
import pytest
from scripted_learner import SPACES, Policy, ScriptedLearner

from daedalus.actor.collecting.client_collector import ClientCollector
from daedalus.actor.session.actor_config import ActorConfig
from daedalus.actor.session.actor_service import ActorService
from daedalus.policy.acting.program_check import PolicyError
from daedalus.policy.acting.runtime import OnnxRuntime
from daedalus.protocol.messages import Snapshot
from daedalus.protocol.spec import PolicySpec, RunSpec
from daedalus.protocol.uploads import Rollout, RolloutIdentity
from daedalus.transport.memory import MemoryNetwork, MemoryTransport

EPSILON = 0.25
SPEC = RunSpec.model_validate(
    {
        "environment": {"id": "CartPole-v1"},
        "policy": {"hidden": [8]},
        "collection": {"envs_per_actor": 8, "rollout_length": 32},
        "training": {"algorithm": "n_step_q"},
    }
)
LIKELY, RANDOM = math.log(1 - EPSILON + EPSILON / 2), math.log(EPSILON / 2)


def learner_of(network: MemoryNetwork, epsilon: float = EPSILON) -> ScriptedLearner:
    learner = ScriptedLearner(network, SPEC, policy=Policy.of(PolicySpec(hidden=(8,)), SPACES, SPEC.training))
    learner.epsilons["a"] = epsilon
    learner.publish(0)
    return learner


def assert_explores(rollout: Rollout) -> None:
    log_probs = rollout.behaviour_log_probs
    is_random = np.isclose(log_probs, RANDOM, atol=1e-5)
    assert (is_random | np.isclose(log_probs, LIKELY, atol=1e-5)).all()
    assert 0 < is_random.mean() < 0.4  # the expected share is 1/8


@pytest.fixture
def stop() -> Iterator[threading.Event]:
    event = threading.Event()
    yield event
    event.set()


@pytest.mark.parametrize("runtime", ["onnx", "torch"])
def test_actor_with_environments(runtime: str, stop: threading.Event) -> None:
    network = MemoryNetwork()
    learner = learner_of(network)
    config = ActorConfig(name="a", incarnation=1, runtime=runtime)  # pyright: ignore[reportArgumentType]
    service = ActorService(config, MemoryTransport(network), stop)
    thread = threading.Thread(target=service.run, daemon=True)
    thread.start()
    assert_explores(learner.receive()[0])
    stop.set()
    service.wake()
    thread.join(timeout=30)
    assert not thread.is_alive()


def test_actor_that_owns_no_loop() -> None:
    policy = learner_of(MemoryNetwork()).policy
    environment = gymnasium.make("CartPole-v1")
    client = ClientCollector(environment.observation_space, environment.action_space, None)
    client.prepare(SPEC.for_actors())
    client.begin(OnnxRuntime(policy.model), SPEC.for_actors(), 3, EPSILON)
    weights = {name: parameter.detach().numpy() for name, parameter in policy.network.named_parameters()}
    client.load(Snapshot(learner_epoch=1, policy_version=0, program="", weights=weights))
    random = np.random.default_rng(1)
    for _ in range(33):
        client.agents[0].act(random.standard_normal(4).astype(np.float32))
    rollout = client.collect(RolloutIdentity(actor="a", incarnation=1, sequence=0, learner_epoch=1))
    assert rollout is not None
    assert_explores(rollout)


def test_actor_refuses_a_program_that_does_not_explore(stop: threading.Event) -> None:
    network = MemoryNetwork()
    learner = ScriptedLearner(network)
    learner.epsilons["a"] = EPSILON
    learner.publish(0)
    service = ActorService(ActorConfig(name="a", incarnation=1), MemoryTransport(network), stop)
    with pytest.raises(PolicyError, match=r"explore with epsilon 0\.25, but its program has no input 'epsilon'"):
        service.run()
