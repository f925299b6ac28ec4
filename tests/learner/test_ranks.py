"""learner/ranks: several processes compute the updates of one."""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import islice
from typing import Any

import numpy as np
import pytest
import torch
from building import ENVIRONMENTS, POLICY, RECURRENT, ROWS, SPACES, identity, make_rollout, make_rollouts
from ranked import assert_equal_state, ranked_learner, spec_of
from torch import Tensor
from torch.testing import assert_close

from daedalus.algorithms.algorithm import Algorithm, Forward, Losses, MinibatchLosses
from daedalus.algorithms.batch import Batch
from daedalus.algorithms.losses import shares_of
from daedalus.algorithms.policy_gradient import Appo, PolicyGradient
from daedalus.learner.ranks import leader
from daedalus.learner.ranks.parts import bounds_of, part_of
from daedalus.learner.training.learner import Learner
from daedalus.policy.user_modules import UserModules
from daedalus.protocol.algorithms import AlgorithmRecord
from daedalus.protocol.spec import PolicySpec, RunSpec
from daedalus.protocol.uploads import Rollout

STEPS = 4
NORMALIZED = PolicySpec(hidden=(8,), normalize_observations=True)
KINDS = {
    "impala": {"algorithm": "impala", "normalize_advantages": True, "max_gradient_norm": 0.1},
    "a2c": {"algorithm": "a2c", "trace_lambda": 0.9, "normalize_rewards": True},
    "a3c": {"algorithm": "a3c", "optimizer": "rmsprop", "value_loss": "huber", "entropy_bonus_final": 0.0},
    "appo": {"algorithm": "appo", "passes": 2, "minibatches": 3, "normalize_advantages": True},
    "one_step_q": {"algorithm": "one_step_q", "target_period": 2},
    "one_step_sarsa": {"algorithm": "one_step_sarsa"},
    "n_step_q": {"algorithm": "n_step_q", "target_period": 3},
}


def batches(state_size: int, count: int = 2) -> list[list[Rollout]]:
    return [make_rollouts(step, count=count, state_size=state_size) for step in range(STEPS)]


def steadily(**training: Any) -> dict[str, Any]:
    """Return settings in which small differences of a gradient stay small differences of an update."""
    return {**training, "precision": "float32", "learning_rate": 0.01, "optimizer_epsilon": 1e-3}


def assert_equals_one_process(number: int, spec: RunSpec, steps: Sequence[list[Rollout]]) -> None:
    """Assert that the updates of so many ranks are those of one process, but for rounding."""
    alone = Learner(spec.training, spec.policy, SPACES)
    for step, rollouts in enumerate(steps):
        alone.step(rollouts, step / STEPS)
    with ranked_learner(number, spec, SPACES) as (learner, ranks):
        for step, rollouts in enumerate(steps):
            assert learner.step(rollouts, step / STEPS) == []
    assert_equal_state(learner, ranks)
    assert learner.policy_version == alone.policy_version
    for name, values in learner.weights().items():
        assert_close(torch.from_numpy(values), torch.from_numpy(alone.weights()[name]), rtol=1e-4, atol=1e-6)
    ours, theirs = learner.metrics.take_means(), alone.metrics.take_means()
    assert ours == pytest.approx(theirs, rel=1e-3, abs=1e-5)
    assert learner.take_diagnostics() == pytest.approx(alone.take_diagnostics(), rel=1e-3, abs=1e-5)
    assert learner.metrics.take_action_counts() == alone.metrics.take_action_counts()
    assert torch.equal(learner.state()["torch_random_state"], alone.state()["torch_random_state"])


@pytest.mark.parametrize("policy", [POLICY, RECURRENT, NORMALIZED], ids=["mlp", "gru", "normalized"])
@pytest.mark.parametrize("kind", KINDS)
def test_two_ranks_equal_one_process_with_the_whole_batch(kind: str, policy: PolicySpec) -> None:
    spec = spec_of(policy, **steadily(**KINDS[kind]))
    assert_equals_one_process(2, spec, batches(5 if policy is RECURRENT else 0))


@pytest.mark.parametrize("policy", [POLICY, RECURRENT], ids=["mlp", "gru"])
@pytest.mark.parametrize("kind", ["impala", "appo", "n_step_q"])
@pytest.mark.parametrize("rollouts", [1, 3])
def test_more_ranks_than_environments_and_uneven_shares(kind: str, policy: PolicySpec, rollouts: int) -> None:
    """Five ranks share 3 or 9 environments; with many minibatches, some have no row of a rank."""
    spec = spec_of(policy, **steadily(**{**KINDS[kind], "minibatches": 8}))
    assert_equals_one_process(5, spec, batches(5 if policy is RECURRENT else 0, rollouts))


def gradients_of_halves(spec: RunSpec, learner: Learner, rollouts: list[Rollout]) -> Tensor:
    """Return the gradient of a batch: those of its two halves, weighted by their rows, added up in order."""
    batch = learner._assembler.join(rollouts)
    width = batch.rewards.shape[1]
    total, rows = torch.zeros(()), batch.valid.sum()
    for bounds in bounds_of(width, 2):
        half = replace(part_of(batch, batch.ranks, *bounds, updates=1), rank_part=None)
        next(learner._gradients.compute(half, learner.entropy_bonus(0.0)))
        total = total + learner._flat.gradients * (half.valid.sum() / rows)
    return total


@pytest.mark.parametrize("policy", [POLICY, RECURRENT], ids=["mlp", "gru"])
@pytest.mark.parametrize("algorithm", ["impala", "a3c"])
def test_the_gradient_is_to_the_bit_the_sum_of_those_of_the_shares(algorithm: str, policy: PolicySpec) -> None:
    spec = spec_of(policy, algorithm=algorithm, max_gradient_norm=1e9, precision="float32")
    rollouts = make_rollouts(3, state_size=5 if policy is RECURRENT else 0)
    expected = gradients_of_halves(spec, Learner(spec.training, policy, SPACES), rollouts)
    with ranked_learner(2, spec, SPACES) as (learner, _):
        learner.step(rollouts, 0.0)
        assert torch.equal(learner._flat.gradients, expected)


def test_mixed_precision_has_the_gradients_of_one_process_in_its_precision() -> None:
    spec = spec_of(POLICY, algorithm="impala", precision="bfloat16", max_gradient_norm=1e9)
    alone = Learner(spec.training, POLICY, SPACES)
    alone.step(make_rollouts(1), 0.0)
    with ranked_learner(2, spec, SPACES) as (learner, _):
        learner.step(make_rollouts(1), 0.0)
        assert_close(learner._flat.gradients, alone._flat.gradients, rtol=0.05, atol=0.01)


@pytest.mark.parametrize("algorithm", ["impala", "appo"])
def test_a_rollout_without_a_finite_gradient_is_left_out_of_all_ranks(algorithm: str) -> None:
    huge: dict[str, Any] = {"rewards": np.full((ROWS, ENVIRONMENTS), np.inf, np.float32)}
    rollouts = [make_rollout(identity(actor), seed=ord(actor), **(huge if actor == "b" else {})) for actor in "abc"]
    spec = spec_of(POLICY, **steadily(algorithm=algorithm))
    alone = Learner(spec.training, POLICY, SPACES)
    alone.step(rollouts, 0.0)
    alone.step(make_rollouts(1), 0.0)
    with ranked_learner(3, spec, SPACES) as (learner, ranks):
        left_out = learner.step(rollouts, 0.0)
        learner.step(make_rollouts(1), 0.0)
    assert [each.identity.actor for each in left_out] == ["b"]
    assert_equal_state(learner, ranks)
    for name, values in learner.weights().items():
        assert_close(torch.from_numpy(values), torch.from_numpy(alone.weights()[name]), rtol=1e-3, atol=1e-5)


def test_a_restored_state_is_that_of_all_ranks() -> None:
    spec = spec_of(NORMALIZED, **steadily(algorithm="n_step_q", target_period=2))
    alone = Learner(spec.training, NORMALIZED, SPACES)
    steps = batches(0)
    for rollouts in steps[:2]:
        alone.step(rollouts, 0.0)
    version, weights, state = alone.policy_version, alone.weights(), alone.state()
    weights = {name: values.copy() for name, values in weights.items()}
    state = {name: values.clone() for name, values in state.items()}
    for rollouts in steps[2:]:
        alone.step(rollouts, 0.0)
    with ranked_learner(3, spec, SPACES, prepare=lambda new: new.restore(version, weights, state)) as (learner, ranks):
        for rollouts in steps[2:]:
            learner.step(rollouts, 0.0)
    assert_equal_state(learner, ranks)
    for name, values in learner.weights().items():
        assert_close(torch.from_numpy(values), torch.from_numpy(alone.weights()[name]), rtol=1e-4, atol=1e-6)


def test_ranks_that_have_drifted_apart_get_the_state_of_the_first(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(leader, "_STATE_BATCHES", 2)
    with ranked_learner(2, spec_of(POLICY, algorithm="impala"), SPACES) as (learner, ranks):
        learner.step(make_rollouts(1), 0.0)
        ranks[0].learner._flat.values.add_(0.5)
        learner.step(make_rollouts(2), 0.0)
    assert_equal_state(learner, ranks)


class OwnMinibatches(Algorithm):
    """Makes an update of each environment, so that the ranks make different numbers."""

    record = AlgorithmRecord(passes_over_batch=True)

    def losses(self, batch: Batch, forward: Forward) -> Iterator[Losses]:
        for column in range(batch.rewards.shape[1]):
            part = batch.map(lambda values: values[:, column : column + 1])  # noqa: B023
            parameters, values = forward(part.observations, batch.initial_state[column : column + 1], part.starts)
            log_probs, entropies = self.distribution.log_prob_and_entropy(parameters[:-1], part.actions, part.masks)
            shares = shares_of(part.valid)
            policy_loss = -(log_probs * part.rewards * shares).sum()
            yield Losses(policy_loss, entropies, values[:-1], part.rewards, shares)


def test_an_algorithm_that_makes_fewer_updates_on_some_ranks_does_not_hang() -> None:
    name, modules = f"{__name__}:OwnMinibatches", UserModules(frozenset({__name__}))
    record = OwnMinibatches.record.model_dump()
    spec = spec_of(RECURRENT, algorithm=name, passes=1, minibatches=64, algorithm_record=record)
    with ranked_learner(2, spec, SPACES, modules) as (learner, ranks):
        learner.step(make_rollouts(1, state_size=5), 0.0)
        learner.step(make_rollouts(2, state_size=5), 0.0)
    assert learner.policy_version == 2 * 2 * ENVIRONMENTS
    assert_equal_state(learner, ranks)


class NothingWithoutRows(PolicyGradient):
    """Makes no update of a part without rows to learn from, and has a first pass otherwise."""

    record = AlgorithmRecord(synchronous=True)

    def losses(self, batch: Batch, forward: Forward) -> Iterator[Losses]:
        return super().losses(batch, forward) if batch.valid.any() else iter(())


@pytest.mark.parametrize("empty", [0, 1])
def test_batch_of_which_an_own_algorithm_makes_no_update_on_one_rank_is_learned_from(empty: int) -> None:
    name, modules = f"{__name__}:NothingWithoutRows", UserModules(frozenset({__name__}))
    spec = spec_of(POLICY, algorithm=name, algorithm_record=NothingWithoutRows.record.model_dump())
    rollouts = make_rollouts(1, count=2)
    none = np.zeros_like(rollouts[0].valid)
    rollouts[empty] = replace(rollouts[empty], valid=none, terminated=none, truncated=none)
    with ranked_learner(2, spec, SPACES, modules) as (learner, ranks):
        before = {name: values.copy() for name, values in learner.weights().items()}
        assert learner.step(rollouts, 0.0) == []
        assert learner.take_diagnostics() == {}
        learner.step(make_rollouts(2, count=2), 0.0)
        assert learner.take_diagnostics()
    assert any((learner.weights()[name] != values).any() for name, values in before.items())
    assert_equal_state(learner, ranks)


class TwoUpdates(Appo):
    """Stops its passes early."""

    record = AlgorithmRecord(passes_over_batch=True)

    def losses(self, batch: Batch, forward: Forward) -> Iterator[MinibatchLosses]:
        return islice(super().losses(batch, forward), 2)


@pytest.mark.parametrize("number", [2, 3])
def test_no_rank_makes_updates_after_an_algorithm_has_stopped_early(number: int) -> None:
    """Those with a gradient of 0 would still move the parameters, by the momentum of the optimiser."""
    name, modules = f"{__name__}:TwoUpdates", UserModules(frozenset({__name__}))
    settings = steadily(minibatches=2)
    one_pass = spec_of(POLICY, **settings, algorithm="appo", passes=1)
    alone = Learner(one_pass.training, POLICY, SPACES)
    for step in range(STEPS):
        alone.step(make_rollouts(step), 0.0)
    record = TwoUpdates.record.model_dump()
    spec = spec_of(POLICY, **settings, algorithm=name, algorithm_record=record, passes=3)
    with ranked_learner(number, spec, SPACES, modules) as (learner, ranks):
        for step in range(STEPS):
            learner.step(make_rollouts(step), 0.0)
    assert (learner.policy_version, learner.updates_skipped) == (STEPS * 6, 0)
    assert_equal_state(learner, ranks)
    for name, values in learner.weights().items():
        assert_close(torch.from_numpy(values), torch.from_numpy(alone.weights()[name]), rtol=1e-4, atol=1e-6)


@pytest.mark.parametrize("width", [1, 2, 3, 7, 16])
@pytest.mark.parametrize("ranks", [1, 2, 3, 8])
def test_shares_are_nearly_equal_and_cover_the_batch(width: int, ranks: int) -> None:
    bounds = bounds_of(width, ranks)
    assert [column for first, end in bounds for column in range(first, end)] == list(range(width))
    sizes = [end - first for first, end in bounds]
    assert max(sizes) - min(sizes) <= 1
