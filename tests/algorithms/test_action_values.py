"""algorithms/action_values.py and the three methods on it, against loops over single rows in the paper's notation."""

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from building import POLICY, RECURRENT, SPACES, join, make_rollout, make_rollouts
from plain import plain
from torch.testing import assert_close

from daedalus.algorithms.batch import Batch
from daedalus.algorithms.gradients import GradientComputer
from daedalus.algorithms.rollout_gradients import RolloutGradients
from daedalus.learner.run.resuming import CheckpointMismatchError
from daedalus.learner.run.settings import SettingsError, check_rollout_length
from daedalus.learner.training.learner import Learner
from daedalus.policy.network.actor_critic import ActorCritic
from daedalus.policy.user_modules import NetworkError
from daedalus.protocol.spaces import ContinuousSpace, DiscreteSpace, Spaces
from daedalus.protocol.spec import PolicySpec, RunSpec, TrainingSpec
from daedalus.protocol.uploads import Rollout

METHODS = ["one_step_q", "one_step_sarsa", "n_step_q"]
MASKED = SPACES.model_copy(update={"actions": {"action": DiscreteSpace(counts=(4,), masked=True)}})
GAMMA = 0.9


def masked(rollout: Rollout, seed: int) -> Rollout:
    """Return the rollout with random masks, in which its actions are legal."""
    mask = np.random.default_rng(seed).random((rollout.rows, rollout.environments, 4)) < 0.4
    np.put_along_axis(mask, plain(rollout.actions).astype(np.int64), True, -1)
    return replace(rollout, masks={"action": mask})


def batch_of(seed: int, has_masks: bool, state_size: int = 0) -> Batch:
    rollouts = make_rollouts(seed, state_size=state_size)
    if not has_masks:
        return join(rollouts)
    return join([masked(rollout, seed + number) for number, rollout in enumerate(rollouts)], MASKED)


def computer_of(algorithm: str, policy: PolicySpec, spaces: Spaces = SPACES, **training: Any) -> GradientComputer:
    """Return a computer whose target network differs from its network."""
    torch.manual_seed(3)
    spec = TrainingSpec(algorithm=algorithm, discount_factor=GAMMA, **training)
    network = ActorCritic(policy, spaces, training=spec)
    with torch.no_grad():
        for parameter in network.learned_parameters():
            parameter.add_(0.3 * torch.randn_like(parameter))
    computer = GradientComputer(spec, network, spaces)
    with torch.no_grad():
        computer.forward.target_values.add_(0.3 * torch.randn_like(computer.forward.target_values))
    return computer


def values_row_by_row(network: ActorCritic, batch: Batch) -> dict[tuple[int, int], torch.Tensor]:
    """Return Q(s, .) [choices] by row and environment."""
    found = {}
    for b in range(batch.rewards.shape[1]):
        state = batch.initial_state[b : b + 1]
        for t in range(len(batch.rewards) + 1):
            if batch.starts[t, b]:
                state = torch.zeros_like(state)
            seen = {name: values[t, b : b + 1] for name, values in batch.observations.items()}
            values, state = network.step(seen, state)
            found[t, b] = values[0]
    return found


def slow_targets(algorithm: str, batch: Batch, target: ActorCritic, lam: float) -> dict[tuple[int, int], float]:
    """Return the target of every row that can be learned from."""
    rows, environments = batch.rewards.shape
    with torch.no_grad():
        values = values_row_by_row(target, batch)
    needs_next_row = algorithm == "one_step_sarsa" or bool(batch.masks)

    def bootstrap(t: int, b: int) -> float:
        """Value of the observation of row t, from which the row before it bootstraps."""
        if algorithm == "one_step_sarsa":
            return values[t, b][plain(batch.actions)[t, b, 0]].item()
        legal = plain(batch.masks)[t, b].tolist() if batch.masks else [True] * 4
        return max(value for value, is_legal in zip(values[t, b].tolist(), legal, strict=True) if is_legal)

    targets: dict[tuple[int, int], float] = {}
    for b in range(environments):
        for t in reversed(range(rows)):
            if not batch.valid[t, b]:
                continue
            reward = batch.rewards[t, b].item()
            if batch.terminated[t, b]:
                targets[t, b] = reward
                continue
            if t == rows - 1 and needs_next_row:
                continue
            following = one = bootstrap(t + 1, b)
            ends = bool(batch.truncated[t, b])
            if algorithm == "n_step_q" and not ends and (t + 1, b) in targets:
                following = (1.0 - lam) * one + lam * targets[t + 1, b]
            targets[t, b] = reward + GAMMA * following
    return targets


@pytest.mark.parametrize("policy", [POLICY, RECURRENT], ids=["mlp", "gru"])
@pytest.mark.parametrize("has_masks", [False, True], ids=["unmasked", "masked"])
@pytest.mark.parametrize("algorithm", [*METHODS, "n_step_q, lambda"])
def test_gradient_is_that_of_the_paper_row_by_row(algorithm: str, has_masks: bool, policy: PolicySpec) -> None:
    algorithm, *mixed = algorithm.split(", ")
    lam = 0.7 if mixed else 1.0
    spaces = MASKED if has_masks else SPACES
    computer = computer_of(algorithm, policy, spaces, trace_lambda=lam)
    network, target = computer.forward._network, computer.forward._target
    assert target is not None
    kinds = set()
    for seed in range(6):
        batch = batch_of(seed, has_masks, network.state_size)
        targets = slow_targets(algorithm, batch, target, lam)
        kinds |= {"last row"} if any(t == len(batch.rewards) - 1 for t, _ in targets) else set()
        kinds |= {name for name in ("terminated", "truncated", "starts") if getattr(batch, name).any()}
        (terms,) = computer.compute(batch, 0.01)
        values = values_row_by_row(network, batch)
        errors = [values[cell][plain(batch.actions)[(*cell, 0)]] - goal for cell, goal in targets.items()]
        loss = torch.stack(errors).square().mean()
        gradients = torch.autograd.grad(0.5 * loss, network.learned_parameters(), materialize_grads=True)
        expected = torch.cat([gradient.flatten() for gradient in gradients])
        assert expected.abs().max() > 1e-3
        assert_close(computer.parameters.gradients, expected, rtol=1e-4, atol=1e-6)
        assert_close(terms.value_loss, loss.detach(), rtol=1e-4, atol=1e-6)
        assert terms.policy_loss == terms.entropy == 0.0
        assert not any(parameter.grad is not None for parameter in target.parameters())
    assert kinds == {"last row", "terminated", "truncated", "starts"}


def test_one_case_by_hand() -> None:
    """Two environments of three rows; the target network has Q = (1, 5, 2, 3) everywhere; gamma is 0.9."""
    rewards = np.array([[1.0, 1.0], [2.0, 2.0], [4.0, 4.0]], np.float32)
    terminated = np.array([[0, 0], [0, 1], [0, 0]], np.bool_)
    rollout = make_rollout(
        rows=3,
        environments=2,
        rewards=rewards,
        terminated=terminated,
        truncated=np.zeros((3, 2), np.bool_),
        valid=np.array([[1, 1], [1, 1], [1, 0]], np.bool_),
        actions=np.array([[0, 0], [2, 2], [3, 3]], np.uint8),
        episode_returns=np.zeros(1, np.float32),
        episode_lengths=np.ones(1, np.int32),
    )
    expected = {
        "one_step_q": [[1 + 4.5, 1 + 4.5], [2 + 4.5, 2.0], [4 + 4.5, math.nan]],
        "one_step_sarsa": [[1 + 1.8, 1 + 1.8], [2 + 2.7, 2.0], [math.nan, math.nan]],
        "n_step_q": [[1 + 0.9 * (2 + 0.9 * 8.5), 1 + 0.9 * 2], [2 + 0.9 * 8.5, 2.0], [8.5, math.nan]],
    }
    for algorithm, targets in expected.items():
        computer = computer_of(algorithm, POLICY)
        computer.forward.target_values.zero_()
        computer.forward.target_parameters["policy_head.bias"].copy_(torch.tensor([1.0, 5.0, 2.0, 3.0]))
        list(computer.compute(join([rollout]), 0.0))
        first = computer.take_first_pass()
        assert first is not None
        assert first.valid.tolist() == (~np.isnan(targets)).astype(float).tolist()
        assert_close(first.targets[first.valid > 0], torch.tensor(targets)[first.valid > 0])


def test_n_step_targets_of_one_row_are_those_of_one_step() -> None:
    batch = batch_of(4, has_masks=False)
    gradients = []
    for algorithm, lam in (("one_step_q", 1.0), ("n_step_q", 0.0)):
        computer = computer_of(algorithm, POLICY, trace_lambda=lam)
        list(computer.compute(batch, 0.0))
        gradients.append(computer.parameters.gradients.clone())
    assert_close(*gradients)


@pytest.mark.parametrize("algorithm", METHODS)
def test_illegal_next_actions_do_not_count_whatever_their_values(algorithm: str) -> None:
    computer = computer_of(algorithm, POLICY, MASKED)
    rollout = make_rollout(seed=2, actions=np.zeros((6, 3), np.uint8))
    mask = np.zeros((6, 3, 4), np.bool_)
    mask[..., 0] = True
    batch = join([replace(rollout, masks={"action": mask})], MASKED)
    list(computer.compute(batch, 0.0))
    before = computer.parameters.gradients.clone()
    computer.forward.target_parameters["policy_head.bias"].add_(torch.tensor([0.0, 50.0, 50.0, 50.0]))
    list(computer.compute(batch, 0.0))
    assert_close(computer.parameters.gradients, before)


# ------------------------------------------------------------------------------- the target network, checkpoints


def learner_of(algorithm: str = "n_step_q", policy: PolicySpec = POLICY, **training: Any) -> Learner:
    return Learner(TrainingSpec(algorithm=algorithm, **training), policy, SPACES)


def test_the_target_network_is_copied_every_period() -> None:
    learner = learner_of(target_period=3)
    versions = [learner.weights()["policy_head.weight"].copy()]
    for step in range(7):
        learner.step(make_rollouts(step), 0.0)
        versions.append(learner.weights()["policy_head.weight"].copy())
        target = learner._gradients.forward.target_parameters["policy_head.weight"].numpy()
        assert np.array_equal(target, versions[(step + 1) // 3 * 3])
    assert not np.array_equal(versions[3], versions[0])


@pytest.mark.parametrize("policy", [POLICY, RECURRENT], ids=["mlp", "gru"])
def test_a_resumed_learner_continues_to_the_bit(policy: PolicySpec) -> None:
    common: dict[str, Any] = {"target_period": 4, "normalize_rewards": True, "optimizer": "rmsprop"}
    policy = policy.model_copy(update={"normalize_observations": True})
    whole, resumed = learner_of(policy=policy, **common), learner_of(policy=policy, seed=9, **common)
    for step in range(6):
        whole.step(make_rollouts(step, state_size=whole.state_size), step / 12)
    whole.anneal_exploration(0.5)
    state = {name: values.clone() for name, values in whole.state().items()}
    saved = {name: values.copy() for name, values in whole.weights().items()}
    resumed.restore(whole.policy_version, saved, state)
    assert np.array_equal(resumed.weights()["exploration.annealing"], saved["exploration.annealing"])
    for step in range(6, 12):
        for learner in (whole, resumed):
            learner.step(make_rollouts(step, state_size=whole.state_size), step / 12)
        for name, values in whole.weights().items():
            assert np.array_equal(resumed.weights()[name], values), name
    with pytest.raises(CheckpointMismatchError, match="target_network"):
        resumed.restore(1, saved, {name: values for name, values in state.items() if name != "target_network"})


def test_other_weights_to_begin_with_are_the_target_networks_too() -> None:
    learner, other = learner_of(), learner_of(seed=5)
    learner.load({name: values.copy() for name, values in other.weights().items()})
    target = learner._gradients.forward.target_parameters
    for name, values in target.items():
        assert np.array_equal(values.numpy(), other.weights()[name])
    without = learner_of(exploration=(0.0,))
    without.load({name: values.copy() for name, values in other.weights().items()})  # that explored, in its run


# ----------------------------------------------------------------------------------------------- gradients


@pytest.mark.parametrize("memory", ["none", "gru"])
@pytest.mark.parametrize("algorithm", METHODS)
def test_gradients_of_actors_make_the_updates_of_the_rollouts_to_the_bit(algorithm: str, memory: str) -> None:
    """Snapshots bring the target network. Rounding is left out: the sum of what is sent is tested elsewhere."""
    spec = RunSpec.model_validate(
        {
            "environment": {"id": "Any-v0"},
            "policy": {"hidden": (8,), "normalize_observations": True, "memory": memory, "memory_units": 5},
            "collection": {"rollout_length": 6, "envs_per_actor": 3, "upload": "gradients"},
            "training": {"algorithm": algorithm, "target_period": 2, "normalize_rewards": True},
        }
    )
    by_rollouts, by_gradients = (Learner(spec.training, spec.policy, SPACES) for _ in range(2))
    actor = RolloutGradients(spec.learning, SPACES)
    actor._in_float32 = True
    for turn in range(5):
        rollout = make_rollout(seed=turn, state_size=by_rollouts.state_size)
        actor.load({name: values.copy() for name, values in by_gradients.weights().items()} | inputs(by_gradients))
        by_gradients.apply([actor.compute(rollout)], turn / 5)
        assert by_rollouts.step([rollout], turn / 5) == []
        for name, values in by_rollouts.weights().items():
            assert np.array_equal(by_gradients.weights()[name], values), name
        for name, values in by_rollouts.state().items():
            assert torch.equal(by_gradients.state()[name], values), name
        assert by_gradients.take_diagnostics() == by_rollouts.take_diagnostics()


def inputs(learner: Learner) -> dict[str, np.ndarray]:
    return {name: values.copy() for name, values in learner.gradient_inputs(0.0).items()}


# ----------------------------------------------------------------------------------------------- what is refused


@pytest.mark.parametrize(
    ("actions", "reason"),
    [
        (
            {"action": ContinuousSpace(low=(-1.0,), high=(1.0,))},
            "this environment has 1 continuous from -1 to 1: use a2c, a3c, impala or appo, or name discrete actions "
            "with environment.action_table",
        ),
        ({"action": DiscreteSpace(counts=(2, 3))}, "has choices of 2 x 3: use a2c, a3c, impala or appo"),
        (
            {"legs": DiscreteSpace(counts=(2,)), "arm": DiscreteSpace(counts=(3,))},
            "has legs: 2 choices, arm: 3 choices: use a2c, a3c, impala or appo",
        ),
    ],
)
@pytest.mark.parametrize("algorithm", METHODS)
def test_other_actions_than_one_choice_are_refused_in_one_line(algorithm: str, actions: Any, reason: str) -> None:
    spaces = SPACES.model_copy(update={"actions": actions})
    with pytest.raises(NetworkError) as caught:
        Learner(TrainingSpec(algorithm=algorithm), POLICY, spaces)
    assert str(caught.value).startswith(
        f"training.algorithm={algorithm} learns the value of each choice of one discrete"
    )
    assert str(caught.value).endswith(reason)


def test_sarsa_with_rollouts_of_one_row_is_refused() -> None:
    content = {"environment": {"id": "A"}, "collection": {"rollout_length": 1}}
    RunSpec.model_validate(content | {"training": {"algorithm": "one_step_q"}})
    with pytest.raises(ValueError, match="one_step_sarsa learns from an action and the next one: make it at least 2"):
        RunSpec.model_validate(content | {"training": {"algorithm": "one_step_sarsa"}})


def test_masked_actions_with_rollouts_of_one_row_are_refused() -> None:
    content = {"environment": {"id": "A"}, "collection": {"rollout_length": 1}}
    spec = RunSpec.model_validate(content | {"training": {"algorithm": "n_step_q"}})
    check_rollout_length(spec, SPACES)
    with pytest.raises(SettingsError, match="n_step_q needs the mask of the next row"):
        check_rollout_length(spec, MASKED)
    check_rollout_length(RunSpec.model_validate(content), MASKED)
