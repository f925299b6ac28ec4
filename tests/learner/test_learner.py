"""learner/learner.py against the same update written out plainly, and against itself after a restart."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from building import POLICY, SPACES, make_batch, make_rollout, run_spec
from oracles import Stream, lambda_return, vtrace, vtrace_advantage
from torch import Tensor, nn
from torch.testing import assert_close

from learner.batch import Batch, join_rollouts
from learner.checkpoint import load_checkpoint, save_checkpoint
from learner.learner import METRICS, Learner
from policy.network import ActorCritic
from protocol.spec import PolicySpec, TrainingSpec

STEPS = 5


def make_learner(policy: PolicySpec = POLICY, **training: Any) -> Learner:
    return Learner(TrainingSpec.model_validate(training), policy, SPACES)


def weights(learner: Learner) -> dict[str, np.ndarray]:
    return {name: array.copy() for name, array in learner.weights().items()}


def assert_same(ours: dict[str, np.ndarray], theirs: dict[str, np.ndarray]) -> None:
    """To the bit."""
    assert ours.keys() == theirs.keys()
    for name, array in ours.items():
        np.testing.assert_array_equal(array, theirs[name])


# --------------------------------------------------------------------------- the update, written plainly


class PlainLearner:
    """One row at a time where the learner has vectors, torch's modules where it has its own."""

    def __init__(self, spec: TrainingSpec, start: dict[str, np.ndarray]) -> None:
        self.spec = spec
        self.network = ActorCritic(POLICY, SPACES)
        self.network.load_state_dict({name: torch.from_numpy(array) for name, array in start.items()})
        self.parameters = list(self.network.parameters())
        self.adam = torch.optim.Adam(self.parameters, eps=spec.optimizer_epsilon)
        self.squares = [torch.zeros_like(parameter) for parameter in self.parameters]

    def step(self, batch: Batch, rate: float, bonus: float) -> dict[str, float]:
        spec, cells = self.spec, batch.valid.nonzero().tolist()
        columns, log_probs, entropies, values = self._play_back(batch)
        targets = {(t, b): self._targets(columns[b], t) for t, b in cells}
        advantages = torch.tensor([targets[t, b][1] for t, b in cells])
        if spec.normalize_advantages:
            advantages = (advantages - advantages.mean()) / (advantages.std(correction=0) + 1e-8)
        chosen = torch.stack([log_probs[b][t] for t, b in cells])
        predicted = torch.stack([values[b][t] for t, b in cells])
        goals = torch.tensor([targets[t, b][0] for t, b in cells])
        entropy = torch.stack([entropies[b][t] for t, b in cells]).mean()
        policy_loss = -(chosen * advantages).mean()
        criterion = nn.MSELoss() if spec.value_loss == "mse" else nn.HuberLoss()
        value_loss = criterion(predicted, goals)
        self.network.zero_grad()
        (policy_loss + spec.value_coefficient * value_loss - bonus * entropy).backward()
        norm = nn.utils.clip_grad_norm_(self.parameters, spec.max_gradient_norm)
        self._descend(rate)
        with torch.no_grad():
            explained = 1.0 - (goals - predicted).var(correction=0) / goals.var(correction=0)
        return {
            "policy_loss": policy_loss.item(),
            "value_loss": value_loss.item(),
            "entropy": entropy.item(),
            "explained_variance": explained.item(),
            "gradient_norm": norm.item(),
            "value_mean": predicted.mean().item(),
        }

    def _play_back(self, batch: Batch) -> tuple[list[Stream], list[Tensor], list[Tensor], list[Tensor]]:
        """Each environment on its own: its rows in the papers' terms, log-probabilities, entropies, values."""
        streams, log_probs, entropies, values = [], [], [], []
        for b in range(batch.actions.shape[1]):
            logits, value = self.network(batch.observations[:, b])
            policy = torch.distributions.Categorical(logits=logits[:-1])
            log_probs.append(policy.log_prob(batch.actions[:, b]))
            entropies.append(policy.entropy())
            values.append(value)
            streams.append(
                Stream(
                    r=batch.rewards[:, b].tolist(),
                    V=value.tolist(),
                    log_ratios=(log_probs[-1].detach() - batch.behaviour_log_probs[:, b]).tolist(),
                    terminated=batch.terminated[:, b].tolist(),
                    truncated=batch.truncated[:, b].tolist(),
                    valid=batch.valid[:, b].tolist(),
                )
            )
        return streams, log_probs, entropies, values

    def _targets(self, x: Stream, t: int) -> tuple[float, float]:
        spec = self.spec
        gamma, lam = spec.discount_factor, spec.trace_lambda
        if spec.algorithm == "impala":
            clips = (spec.rho_clip, spec.trace_clip)
            return vtrace(x, gamma, lam, *clips, t), vtrace_advantage(x, gamma, lam, *clips, t)
        goal = lambda_return(x, gamma, lam, t)
        return goal, goal - x.V[t]

    def _descend(self, rate: float) -> None:
        if self.spec.optimizer == "adam":
            self.adam.param_groups[0]["lr"] = rate
            self.adam.step()
            return
        decay, epsilon = self.spec.rmsprop_decay, self.spec.optimizer_epsilon
        with torch.no_grad():
            for parameter, square in zip(self.parameters, self.squares, strict=True):
                assert parameter.grad is not None
                square.copy_(decay * square + (1.0 - decay) * parameter.grad**2)
                parameter -= rate * parameter.grad / (square + epsilon).sqrt()


KINDS = {
    "a2c": {"algorithm": "a2c", "trace_lambda": 0.9, "max_gradient_norm": 0.1},
    "a3c, rmsprop": {"algorithm": "a3c", "optimizer": "rmsprop", "max_gradient_norm": 100.0},
    "huber": {"algorithm": "a2c", "value_loss": "huber", "value_coefficient": 0.7},
    "normalised": {"algorithm": "a2c", "normalize_advantages": True, "trace_lambda": 0.5},
    "impala": {"algorithm": "impala", "trace_lambda": 0.95, "rho_clip": 1.5, "trace_clip": 0.8},
    "impala, all": {
        "algorithm": "impala",
        "optimizer": "rmsprop",
        "value_loss": "huber",
        "normalize_advantages": True,
    },
}


@pytest.mark.parametrize("kind", KINDS)
def test_updates_are_those_of_the_plain_implementation(kind: str) -> None:
    spec = TrainingSpec.model_validate(
        {
            **KINDS[kind],
            "discount_factor": 0.9,
            "optimizer_epsilon": 1e-3,
            "learning_rate": 0.02,
            "learning_rate_final": 0.01,
            "entropy_bonus": 0.1,
            "entropy_bonus_final": 0.0,
        }
    )
    learner = Learner(spec, POLICY, SPACES)
    plain = PlainLearner(spec, weights(learner))
    for step in range(STEPS):
        batch, progress = make_batch(step), step / STEPS
        learner.step(batch, progress)
        metrics = plain.step(batch, rate=0.02 - 0.01 * progress, bonus=0.1 - 0.1 * progress)
        taken = learner.take_metrics()
        assert {name: taken[name] for name in metrics} == pytest.approx(metrics, rel=1e-3, abs=1e-4)
        for name, parameter in plain.network.named_parameters():
            assert_close(torch.from_numpy(learner.weights()[name]), parameter.detach(), rtol=1e-4, atol=1e-5)
    assert learner.policy_version == STEPS


# --------------------------------------------------------------------------------------------- the rest


def test_rates_are_annealed_over_the_budget_and_no_further() -> None:
    learner = make_learner(
        learning_rate=0.4, learning_rate_final=0.2, entropy_bonus=0.0, entropy_bonus_final=1.0, algorithm="a2c"
    )
    shares = (-1.0, 0.0, 0.25, 0.5, 1.0, 1.5)
    assert [learner.learning_rate(share) for share in shares] == pytest.approx([0.4, 0.4, 0.35, 0.3, 0.2, 0.2])
    assert [learner.entropy_bonus(share) for share in shares] == pytest.approx([0.0, 0.0, 0.25, 0.5, 1.0, 1.0])


def test_rates_without_a_final_one_stay() -> None:
    learner = make_learner(learning_rate=0.4, entropy_bonus=0.3)
    assert [learner.learning_rate(share) for share in (0.0, 0.7, 1.0)] == [0.4] * 3
    assert [learner.entropy_bonus(share) for share in (0.0, 0.7, 1.0)] == [0.3] * 3


def test_a_final_rate_of_0_is_not_taken_for_none() -> None:
    learner = make_learner(learning_rate_final=0.0, entropy_bonus_final=0.0)
    assert (learner.learning_rate(1.0), learner.entropy_bonus(1.0)) == (0.0, 0.0)


@pytest.mark.parametrize("algorithm", ["a2c", "impala"])
def test_the_same_seed_gives_the_same_weights_to_the_bit(algorithm: str) -> None:
    def trained(seed: int) -> dict[str, np.ndarray]:
        learner = make_learner(algorithm=algorithm, seed=seed)
        for step in range(STEPS):
            learner.step(make_batch(step), 0.0)
        return weights(learner)

    assert_same(trained(3), trained(3))
    assert not np.array_equal(trained(3)["policy_head.weight"], trained(4)["policy_head.weight"])


@pytest.mark.parametrize("algorithm", ["a2c", "impala"])
@pytest.mark.parametrize("normalize", [False, True])
def test_what_a_reset_row_holds_changes_no_weight(algorithm: str, normalize: bool) -> None:
    batch = make_batch(1)
    resets = batch.valid == 0.0
    assert resets.any()
    garbage = replace(
        batch,
        actions=torch.where(resets, 3 - batch.actions, batch.actions),
        rewards=torch.where(resets, 1e4, batch.rewards),
        behaviour_log_probs=torch.where(resets, -20.0, batch.behaviour_log_probs),
    )
    results = []
    for each in (batch, garbage):
        learner = make_learner(algorithm=algorithm, normalize_advantages=normalize)
        learner.step(each, 0.0)
        results.append((weights(learner), learner.take_metrics()))
    assert_same(results[0][0], results[1][0])
    assert results[0][1] == results[1][1]


def test_metrics_are_means_since_they_were_last_taken() -> None:
    apart, together = make_learner(), make_learner()
    taken = []
    for step in range(3):
        apart.step(make_batch(step), 0.0)
        taken.append(apart.take_metrics())
        together.step(make_batch(step), 0.0)
    means = {name: float(np.mean([row[name] for row in taken])) for name in METRICS}
    assert together.take_metrics() == pytest.approx(means, rel=1e-5)
    assert together.take_metrics() == {}


def test_advantage_std_is_the_standard_deviation_of_the_advantages() -> None:
    # Without discounting to come, A = r - V; and V starts as 0 where the observation is 0.
    rewards = torch.linspace(4.0, 6.0, 18).reshape(6, 3).numpy()
    nothing, everything = np.zeros((6, 3), np.bool_), np.ones((6, 3), np.bool_)
    rollout = make_rollout(
        observations=np.zeros((7, 3, 3), np.float32),
        rewards=rewards,
        terminated=nothing,
        truncated=nothing,
        valid=everything,
    )
    learner = make_learner(algorithm="a2c", discount_factor=0.0)
    learner.step(join_rollouts([rollout]), 0.0)
    assert learner.take_metrics()["advantage_std"] == pytest.approx(rewards.std(), rel=1e-4)


# --------------------------------------------------------------------------------------------- restarts


def saved(learner: Learner, directory: Path) -> Path:
    return save_checkpoint(
        directory,
        spec=run_spec(),
        spaces=SPACES,
        policy_version=learner.policy_version,
        program=b"program",
        parameters=learner.weights(),
        state=learner.state(),
        counters={},
        keep=1,
    )


def restored(learner: Learner, directory: Path) -> Learner:
    checkpoint = load_checkpoint(directory)
    learner.restore(checkpoint.policy.policy_version, checkpoint.policy.weights, checkpoint.state)
    return learner


@pytest.mark.parametrize("optimizer", ["adam", "rmsprop"])
def test_a_restored_learner_goes_on_to_the_bit(optimizer: str, tmp_path: Path) -> None:
    through = make_learner(optimizer=optimizer)
    for step in range(10):
        through.step(make_batch(step), step / 10)

    first = make_learner(optimizer=optimizer)
    for step in range(5):
        first.step(make_batch(step), step / 10)
    checkpoint = saved(first, tmp_path)
    first.step(make_batch(99), 0.0)  # what was saved is no view of what goes on
    second = restored(make_learner(optimizer=optimizer, seed=99), checkpoint)
    assert second.policy_version == 5
    for step in range(5, 10):
        second.step(make_batch(step), step / 10)

    assert second.policy_version == 10
    assert_same(weights(through), weights(second))
    for name, value in through.state().items():
        if name.startswith("optimizer/"):
            assert torch.equal(value, second.state()[name])


def test_the_random_state_is_restored(tmp_path: Path) -> None:
    learner = make_learner()
    checkpoint = saved(learner, tmp_path)
    expected = torch.rand(4)
    restored(make_learner(seed=9), checkpoint)
    assert torch.equal(torch.rand(4), expected)


def test_parameters_of_another_network_are_refused(tmp_path: Path) -> None:
    checkpoint = saved(make_learner(), tmp_path)
    for other in (PolicySpec(hidden=(9,)), PolicySpec(hidden=(8, 8))):
        with pytest.raises(ValueError, match="another network"):
            restored(make_learner(other), checkpoint)


@pytest.mark.parametrize(("wrote", "reads"), [("rmsprop", "adam"), ("adam", "rmsprop")])
def test_statistics_of_another_optimiser_are_refused(wrote: str, reads: str, tmp_path: Path) -> None:
    checkpoint = saved(make_learner(optimizer=wrote), tmp_path)
    with pytest.raises(ValueError, match="another optimiser"):
        restored(make_learner(optimizer=reads), checkpoint)
