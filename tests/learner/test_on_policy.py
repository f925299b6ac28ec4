"""Log-probabilities of learner and actor are equal under the same weights, so on-policy ratios are 1."""

import copy
from typing import Any

import numpy as np
import pytest
import torch
from allowed_modules import TEST_MODULES
from building import join
from collectors import started_collector

from daedalus.actor.environments.make import make_environments
from daedalus.policy.acting.program import export_program
from daedalus.policy.acting.runtime import OnnxRuntime, PolicyRuntime
from daedalus.policy.acting.torch_runtime import TorchRuntime
from daedalus.policy.network.actor_critic import ActorCritic
from daedalus.protocol.codec import decode, encode
from daedalus.protocol.limits import Limits
from daedalus.protocol.spaces import Spaces
from daedalus.protocol.spec import EnvironmentSpec, PolicySpec
from daedalus.protocol.uploads import Rollout, RolloutIdentity

IDENTITY = RolloutIdentity(actor="a", incarnation=1, sequence=0, learner_epoch=1)
POLICIES = {
    "mlp": PolicySpec(hidden=(8,)),
    "gru": PolicySpec(hidden=(8,), memory="gru", memory_units=6),
}


def make_runtime(kind: str, policy: PolicySpec, spaces: Spaces, network: ActorCritic) -> PolicyRuntime:
    if kind == "torch":
        return TorchRuntime(policy, spaces)
    return OnnxRuntime(export_program(network, spaces))


@pytest.mark.parametrize("runtime", ["onnx", "torch"])
@pytest.mark.parametrize("stack", [1, 3])
@pytest.mark.parametrize("policy", POLICIES)
def test_learner_and_actor_log_probabilities_are_equal_under_the_same_weights(
    policy: str, stack: int, runtime: str
) -> None:
    # Episodes have 3, 2 and 1 steps, so every rollout of 5 rows contains starts and ends of episodes.
    spec = EnvironmentSpec(id="counting_environment:Counting-v0", frame_stack=stack)
    environments = make_environments(spec, 4, modules=TEST_MODULES)
    spaces = environments.spaces
    torch.manual_seed(1)
    network = ActorCritic(POLICIES[policy], spaces)
    with torch.no_grad():
        network.policy_head.weight.mul_(100.0)  # far from uniform, so that log-probabilities depend on the observation
    weights = {name: parameter.detach().numpy() for name, parameter in network.named_parameters()}
    collector = started_collector(
        spec,
        make_runtime(runtime, POLICIES[policy], spaces, network),
        rollout_length=5,
        seed=2,
        weights=weights,
        environments=environments,
    )
    for _ in range(6):
        rollout: Any = copy.deepcopy(decode(encode(collector.collect(IDENTITY)), Limits()))
        assert isinstance(rollout, Rollout)
        batch = join([rollout], spaces)
        with torch.no_grad():
            parameters, _ = network(batch.observations, batch.initial_state, batch.starts)
            log_probs, _ = network.distribution.log_prob_and_entropy(parameters[:-1], batch.actions, batch.masks)
        valid = rollout.valid
        assert np.ptp(log_probs.numpy()[valid]) > 0.1
        np.testing.assert_allclose(log_probs.numpy()[valid], rollout.behaviour_log_probs[valid], atol=1e-4)
