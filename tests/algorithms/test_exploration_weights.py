"""algorithms/policy_gradient.py where actors explore: the weight of each row in the gradient."""

import pytest
import torch
from building import SPACES, join, make_rollout

from daedalus.algorithms.gradients import GradientComputer
from daedalus.policy.network.actor_critic import ActorCritic
from daedalus.protocol.spec import PolicySpec, TrainingSpec


@pytest.mark.parametrize("algorithm", ["a2c", "a3c", "impala"])
def test_rows_of_explored_actions_are_weighted_by_pi_over_mu(algorithm: str) -> None:
    """The gradient of the policy loss, by loops over rows; the actions of the batch are the actor's own."""
    torch.manual_seed(4)
    spec = TrainingSpec(algorithm=algorithm, exploration=(0.4,), trace_lambda=0.9, value_coefficient=0.0)
    network = ActorCritic(PolicySpec(hidden=(8,)), SPACES, training=spec)
    with torch.no_grad():
        network.policy_head.weight.mul_(200.0)
    rollout = make_rollout(seed=5)
    batch = join([rollout])
    with torch.no_grad():
        logits, _ = network(batch.observations, batch.initial_state, batch.starts)
    policy = torch.distributions.Categorical(logits=logits[:-1])
    actions = batch.actions["action"].squeeze(-1)
    behaviour = 0.6 * policy.log_prob(actions).exp() + 0.4 / 4
    batch.behaviour_log_probs.copy_(behaviour.log())
    computer = GradientComputer(spec, network, SPACES)
    list(computer.compute(batch, 0.0))
    first = computer.take_first_pass()
    assert first is not None
    weights = (policy.log_prob(actions).exp() / behaviour).clamp(max=1.0)
    assert weights.min() < 0.5
    again, _ = network(batch.observations, batch.initial_state, batch.starts)
    chosen = torch.distributions.Categorical(logits=again[:-1]).log_prob(actions)
    rows = batch.valid > 0.0
    loss = -(chosen * weights * first.advantages)[rows].mean()
    expected = torch.autograd.grad(loss, network.learned_parameters(), materialize_grads=True)
    flat = torch.cat([gradient.flatten() for gradient in expected])
    torch.testing.assert_close(computer.parameters.gradients, flat, rtol=1e-4, atol=1e-6)
