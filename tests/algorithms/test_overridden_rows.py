"""Rows whose actions somebody else chose: the policy does not learn from them, and returns end before them.

The oracle cuts each environment's rows into pieces at the overridden rows, as if a rollout ended at each, and sums the
papers' targets of every piece by itself. The memory of the policy sees all rows.
"""

from collections.abc import Iterator

import numpy as np
import pytest
import torch
from building import POLICY, RECURRENT, SPACES, identity, join, make_rollout
from oracles import Stream, lambda_return, vtrace, vtrace_advantage
from torch import Tensor

from daedalus.algorithms.gradients import GradientComputer
from daedalus.algorithms.normalization import ObservationStatistics, RewardNormalizer
from daedalus.policy.network.actor_critic import ActorCritic
from daedalus.policy.network.layers import OneHotCodes
from daedalus.protocol.spec import PolicySpec, TrainingSpec
from daedalus.protocol.uploads import Rollout

ROWS, ENVIRONMENTS = 12, 5
GAMMA, LAMBDA, RHO, C, CLIP = 0.9, 0.8, 1.25, 0.75, 0.3
ENTROPY_BONUS = 0.03


def rollout_with_overrides(state_size: int) -> Rollout:
    plain = make_rollout(rows=ROWS, environments=ENVIRONMENTS, state_size=state_size, seed=4)
    overridden = plain.valid & (np.random.default_rng(8).random((ROWS, ENVIRONMENTS)) < 0.3)
    ends = plain.terminated | plain.truncated
    assert (overridden & ends).any(), "an episode must end in an overridden row"
    assert (overridden[1:] & plain.valid[:-1] & ~overridden[:-1]).any(), "an override must follow a row of the policy"
    return make_rollout(rows=ROWS, environments=ENVIRONMENTS, state_size=state_size, seed=4, overridden=overridden)


def spec_of(algorithm: str) -> TrainingSpec:
    settings = {"discount_factor": GAMMA, "trace_lambda": LAMBDA, "rho_clip": RHO, "trace_clip": C}
    if algorithm == "appo":
        settings |= {"passes": 1, "minibatches": 1, "clip_range": CLIP, "proximal_policy": "behaviour"}
    return TrainingSpec.model_validate({"algorithm": algorithm, "normalize_advantages": False, **settings})


def pieces(rollout: Rollout, environment: int) -> Iterator[range]:
    """Yield the runs of rows between overridden ones."""
    assert rollout.overridden is not None
    cuts = [row for row in range(ROWS) if rollout.overridden[row, environment]]
    for first, last in zip([-1, *cuts], [*cuts, ROWS], strict=True):
        if last > first + 1:
            yield range(first + 1, last)


def expected_loss(spec: TrainingSpec, network: ActorCritic, rollout: Rollout) -> Tensor:
    """The loss of a rollout, row by row, from the slow sums."""
    observations = {"observation": torch.from_numpy(rollout.frames["observation"])}
    starts = torch.from_numpy(np.concatenate([np.zeros((1, ENVIRONMENTS), np.bool_), ~rollout.valid]))
    parameters, values = network(observations, torch.from_numpy(rollout.initial_state), starts)
    actions = {"action": torch.from_numpy(rollout.actions["action"].astype(np.int64))}
    log_probs, entropies = network.distribution.log_prob_and_entropy(parameters[:-1], actions, {})
    log_ratios = (log_probs.detach() - torch.from_numpy(rollout.behaviour_log_probs)).numpy()
    terms: list[Tensor] = []
    for e in range(ENVIRONMENTS):
        for rows in pieces(rollout, e):
            stream = Stream(
                r=rollout.rewards[rows, e].tolist(),
                V=values[rows[0] : rows[-1] + 2, e].tolist(),
                log_ratios=log_ratios[rows, e].tolist(),
                terminated=rollout.terminated[rows, e].tolist(),
                truncated=rollout.truncated[rows, e].tolist(),
                valid=rollout.valid[rows, e].tolist(),
            )
            for s in stream.rows:
                t = rows[s]
                if spec.algorithm == "impala":
                    target = vtrace(stream, GAMMA, LAMBDA, RHO, C, s)
                    factor = vtrace_advantage(stream, GAMMA, LAMBDA, RHO, C, s) * min(RHO, np.exp(log_ratios[t, e]))
                else:
                    target = lambda_return(stream, GAMMA, LAMBDA, s)
                    factor = target - stream.V[s]
                value_loss = (values[t, e] - target) ** 2
                gain = log_probs[t, e] * factor
                if spec.algorithm == "appo":
                    ratio = (log_probs[t, e] - float(rollout.behaviour_log_probs[t, e])).exp()
                    gain = torch.minimum(ratio * factor, ratio.clip(1 - CLIP, 1 + CLIP) * factor)
                terms.append(-gain + spec.value_coefficient * value_loss - ENTROPY_BONUS * entropies[t, e])
    assert len(terms) == rollout.env_steps
    return torch.stack(terms).mean()


@pytest.mark.parametrize("policy", [POLICY, RECURRENT], ids=["none", "gru"])
@pytest.mark.parametrize("algorithm", ["a2c", "a3c", "impala", "appo"])
def test_gradients_are_those_of_the_rows_between_overrides(algorithm: str, policy: PolicySpec) -> None:
    torch.manual_seed(2)
    spec, network = spec_of(algorithm), ActorCritic(policy, SPACES)
    for parameter in network.learned_parameters():  # the first policy is nearly uniform: let it have a preference
        parameter.data.add_(0.2 * torch.randn_like(parameter))
    rollout = rollout_with_overrides(network.state_size)
    parameters = network.learned_parameters()
    expected = torch.cat(
        [each.flatten() for each in torch.autograd.grad(expected_loss(spec, network, rollout), parameters)]
    )
    computer = GradientComputer(spec, network, SPACES)
    (_,) = computer.compute(join([rollout]), ENTROPY_BONUS)
    found = computer.parameters.gradients
    assert expected.norm() > 0.1
    torch.testing.assert_close(found, expected, rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("policy", [POLICY, RECURRENT], ids=["none", "gru"])
@pytest.mark.parametrize("algorithm", ["one_step_q", "one_step_sarsa", "n_step_q"])
def test_action_values_are_learned_between_overrides(algorithm: str, policy: PolicySpec) -> None:
    """The row before an override bootstraps from the action that the policy chose, also with Sarsa."""
    torch.manual_seed(2)
    spec = spec_of(algorithm)
    network = ActorCritic(policy, SPACES, training=spec)
    for parameter in network.learned_parameters():
        parameter.data.add_(0.3 * torch.randn_like(parameter))
    computer = GradientComputer(spec, network, SPACES)  # the target network begins as a copy
    rollout = rollout_with_overrides(network.state_size)
    starts = torch.from_numpy(np.concatenate([np.zeros((1, ENVIRONMENTS), np.bool_), ~rollout.valid]))
    frames = {"observation": torch.from_numpy(rollout.frames["observation"])}
    values, _ = network(frames, torch.from_numpy(rollout.initial_state), starts)  # [T+1, B, choices]
    actions = torch.from_numpy(rollout.actions["action"].astype(np.int64))
    chosen = values[:-1].gather(-1, actions).squeeze(-1)
    following = values.detach().amax(-1)
    if algorithm == "one_step_sarsa":
        following[:-1] = chosen.detach()
    terms: list[Tensor] = []
    for e in range(ENVIRONMENTS):
        for rows in pieces(rollout, e):
            stream = Stream(
                r=rollout.rewards[rows, e].tolist(),
                V=following[rows[0] : rows[-1] + 2, e].tolist(),
                log_ratios=[0.0] * len(rows),
                terminated=rollout.terminated[rows, e].tolist(),
                truncated=rollout.truncated[rows, e].tolist(),
                valid=rollout.valid[rows, e].tolist(),
            )
            for s in stream.rows:
                t = rows[s]
                if algorithm == "one_step_sarsa" and t == ROWS - 1 and not rollout.terminated[t, e]:
                    continue  # its next action is in the next rollout
                target = lambda_return(stream, GAMMA, LAMBDA if algorithm == "n_step_q" else 0.0, s)
                terms.append(spec.value_coefficient * (chosen[t, e] - target) ** 2)
    parameters = network.learned_parameters()
    gradients = torch.autograd.grad(torch.stack(terms).mean(), parameters, allow_unused=True)
    expected = torch.cat(
        [
            (torch.zeros_like(parameter) if gradient is None else gradient).flatten()
            for parameter, gradient in zip(parameters, gradients, strict=True)
        ]
    )
    (_,) = computer.compute(join([rollout]), 0.0)
    assert expected.norm() > 0.1
    torch.testing.assert_close(computer.parameters.gradients, expected, rtol=1e-4, atol=1e-5)


def test_statistics_are_of_the_rows_to_learn_from() -> None:
    rollout = rollout_with_overrides(0)
    policy = POLICY.model_copy(update={"normalize_observations": True})
    statistics = ObservationStatistics(ActorCritic(policy, SPACES).normalizer, OneHotCodes({}))
    assert statistics.moments_of(join([rollout]))["observation"].number == rollout.env_steps
    assert RewardNormalizer(GAMMA).moments_of([rollout]).number == rollout.env_steps
    assert rollout.overridden is not None
    assert rollout.env_steps == np.count_nonzero(rollout.valid & ~rollout.overridden)


def test_frame_stacks_and_memory_go_on_through_overridden_rows() -> None:
    rollout = rollout_with_overrides(0)
    plain = make_rollout(identity(), rows=ROWS, environments=ENVIRONMENTS, seed=4)
    assert torch.equal(join([rollout]).starts, join([plain]).starts)
