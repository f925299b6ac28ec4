"""learner/training/learner.py against a reference implementation, and against itself after a restart."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from building import EPOCH, POLICY, RECURRENT, SPACES, identity, join, make_rollout, make_rollouts, run_spec
from plain import ACTION, NAME, plain, plain_spaces
from plain_learner import PlainLearner
from torch import Tensor
from torch.testing import assert_close

from daedalus.algorithms.gradients import Terms
from daedalus.learner.run.counters import RunCounters
from daedalus.learner.run.resuming import CheckpointMismatchError
from daedalus.learner.training.checkpoint import encode_checkpoint, load_checkpoint, save_checkpoint
from daedalus.learner.training.learner import Learner
from daedalus.learner.training.update_metrics import METRICS, UpdateMetrics
from daedalus.policy.network.actor_critic import ActorCritic
from daedalus.protocol.spaces import ArraySpace
from daedalus.protocol.spec import PolicySpec, TrainingSpec
from daedalus.protocol.uploads import Rollout

STEPS = 3
NORMALIZED = PolicySpec(hidden=(8,), normalize_observations=True)


def learner_spec(**training: Any) -> TrainingSpec:
    return TrainingSpec.model_validate(training)


def make_learner(policy: PolicySpec = POLICY, **training: Any) -> Learner:
    return Learner(learner_spec(**training), policy, SPACES)


def weights(learner: Learner) -> dict[str, np.ndarray]:
    return {name: array.copy() for name, array in learner.weights().items()}


def assert_same(ours: dict[str, np.ndarray], theirs: dict[str, np.ndarray]) -> None:
    """Assert that all arrays are identical."""
    assert ours.keys() == theirs.keys()
    for name, array in ours.items():
        np.testing.assert_array_equal(array, theirs[name])


# ------------------------------------------------------------------------------ reference implementation

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
    "appo": {"algorithm": "appo", "trace_lambda": 0.95, "clip_range": 0.05},
    "appo, behaviour": {"algorithm": "appo", "proximal_policy": "behaviour", "trace_lambda": 0.95},
    "appo, exploring": {
        "algorithm": "appo",
        "proximal_policy": "behaviour",  # has no effect
        "rho_clip": 1.5,
        "exploration": (0.1,),
    },
    "appo, spo": {"algorithm": "appo", "surrogate": "spo", "trace_lambda": 0.95, "clip_range": 0.05},
    "appo, one update": {"algorithm": "appo", "passes": 1, "minibatches": 1},
    "appo, all": {
        "algorithm": "appo",
        "passes": 2,
        "minibatches": 5,
        "clip_range": 0.1,
        "optimizer": "rmsprop",
        "value_loss": "huber",
        "normalize_advantages": True,
    },
}


@pytest.mark.parametrize("policy", [POLICY, RECURRENT], ids=["mlp", "gru"])
@pytest.mark.parametrize("kind", KINDS)
def test_updates_equal_those_of_the_reference_implementation(
    kind: str, policy: PolicySpec, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(torch, "randperm", torch.arange)
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
    learner = Learner(spec, policy, SPACES)
    plain = PlainLearner(spec, policy, weights(learner))
    for step in range(STEPS):
        rollouts, progress = make_rollouts(step, state_size=learner.state_size), step / STEPS
        learner.step(rollouts, progress)
        metrics = plain.step(join(rollouts), rate=0.02 - 0.01 * progress, bonus=0.1 - 0.1 * progress)
        taken = learner.metrics.take_means()
        assert {name: taken[name] for name in metrics} == pytest.approx(metrics, rel=1e-3, abs=1e-4)
        for name, parameter in plain.network.named_parameters():
            assert_close(torch.from_numpy(learner.weights()[name]), parameter.detach(), rtol=1e-4, atol=1e-5)
    assert learner.policy_version == STEPS * spec.updates_per_batch


def first_gradient(learner: Learner, rollouts: list[Rollout]) -> Tensor:
    """Return the gradient of the first update, from Adam's mean: 0.1 times the gradient, because it starts at 0."""
    learner.step(rollouts, 0.0)
    return learner.state()["adam/mean"] * 10.0


@pytest.mark.parametrize("algorithm", ["a2c", "impala"])
def test_recurrent_gradient_over_all_rows_equals_the_gradient_row_by_row(algorithm: str) -> None:
    learner = make_learner(RECURRENT, algorithm=algorithm, max_gradient_norm=1e9)
    plain = PlainLearner(learner_spec(algorithm=algorithm, max_gradient_norm=1e9), RECURRENT, weights(learner))
    rollouts = make_rollouts(3, state_size=learner.state_size)
    batch = join(rollouts)
    assert batch.starts.any()
    plain.step(batch, 0.0, plain.spec.entropy_bonus)
    expected = torch.cat([parameter.grad.flatten() for parameter in plain.parameters if parameter.grad is not None])
    assert expected.abs().max() > 1e-3
    assert_close(first_gradient(learner, rollouts), expected, rtol=1e-4, atol=1e-6)


def on_policy(policy: PolicySpec, start: dict[str, np.ndarray], rollouts: list[Rollout]) -> list[Rollout]:
    """Return the rollouts with the behaviour log-probabilities of the policy with these weights."""
    network = ActorCritic(policy, SPACES)
    network.load_state_dict({name: torch.from_numpy(array) for name, array in start.items()})
    chosen = []
    for rollout in rollouts:
        batch = join([rollout])
        with torch.no_grad():
            logits, _ = network(batch.observations, batch.initial_state, batch.starts)
        log_probs = torch.distributions.Categorical(logits=logits[:-1]).log_prob(plain(batch.actions).squeeze(-1))
        chosen.append(replace(rollout, behaviour_log_probs=log_probs.numpy()))
    return chosen


@pytest.mark.parametrize("policy", [POLICY, RECURRENT], ids=["mlp", "gru"])
def test_first_gradient_is_equal_for_all_algorithms_on_policy(policy: PolicySpec) -> None:
    common = {"max_gradient_norm": 1e9, "passes": 1, "minibatches": 1, "trace_lambda": 0.9}
    learners = {name: make_learner(policy, algorithm=name, **common) for name in ("a2c", "impala", "appo")}
    rollouts = make_rollouts(1, state_size=learners["appo"].state_size)
    rollouts = on_policy(policy, weights(learners["appo"]), rollouts)
    gradients = {name: first_gradient(learner, rollouts) for name, learner in learners.items()}
    assert gradients["impala"].abs().max() > 1e-3
    assert_close(gradients["appo"], gradients["impala"], rtol=1e-4, atol=1e-6)
    assert_close(gradients["a2c"], gradients["impala"], rtol=1e-4, atol=1e-6)
    assert learners["appo"].metrics.take_means()["clipped_fraction"] == 0.0


@pytest.mark.parametrize("policy", [POLICY, RECURRENT], ids=["mlp", "gru"])
def test_first_gradient_of_appo_equals_a2c_where_actors_explore(policy: PolicySpec) -> None:
    """Its ratios are then relative to the policy before the batch; the weights correct for the behaviour policy."""
    common = {"max_gradient_norm": 1e9, "passes": 1, "minibatches": 1, "exploration": (0.1,), "rho_clip": 1.5}
    a2c, appo = (make_learner(policy, algorithm=name, **common) for name in ("a2c", "appo"))
    rollouts = make_rollouts(1, state_size=appo.state_size)
    assert_close(first_gradient(appo, rollouts), first_gradient(a2c, rollouts), rtol=1e-4, atol=1e-6)


def test_appo_stays_near_the_behaviour_policy() -> None:
    """A good action that the updates since have made likely enough is not learned from any more."""
    settings = {"passes": 1, "minibatches": 1, "clip_range": 0.2, "value_coefficient": 0.0, "entropy_bonus": 0.0}
    settings["proximal_policy"] = "behaviour"
    for ratio, clipped in ((1.0, 0.0), (1.1, 0.0), (1.3, 1.0)):
        learner = make_learner(algorithm="appo", **settings)
        before = weights(learner)
        (rollout, *_) = on_policy(POLICY, before, make_rollouts(1, state_size=learner.state_size))
        older = rollout.behaviour_log_probs - np.float32(np.log(ratio))
        learner.step([replace(rollout, behaviour_log_probs=older, rewards=rollout.rewards + 100.0)], 0.0)
        assert learner.metrics.take_means()["clipped_fraction"] == pytest.approx(clipped)
        changed = any(not np.array_equal(array, learner.weights()[name]) for name, array in before.items())
        assert changed == (clipped == 0.0)


@pytest.mark.parametrize("policy", [POLICY, RECURRENT], ids=["mlp", "gru"])
@pytest.mark.parametrize(("passes", "count"), [(1, 1), (3, 4), (2, 50)])
def test_batch_makes_one_version_for_each_minibatch_of_each_pass(policy: PolicySpec, passes: int, count: int) -> None:
    """A batch has 6 environments and fewer than 36 valid rows: it cannot be split into 50 minibatches."""
    learner = make_learner(policy, algorithm="appo", passes=passes, minibatches=count)
    versions = 0
    for step in range(1, 4):
        rollouts = make_rollouts(step, state_size=learner.state_size)
        valid_rows = sum(int(rollout.valid.sum()) for rollout in rollouts)
        learner.step(rollouts, 0.0)
        versions += passes * min(count, 6 if learner.state_size else valid_rows)
        assert learner.policy_version == versions
    assert all(np.isfinite(array).all() for array in weights(learner).values())
    assert all(np.isfinite(value) for value in learner.metrics.take_means().values())


def test_batch_of_one_row_makes_one_version_for_each_pass() -> None:
    learner = make_learner(algorithm="appo", passes=2, minibatches=4)
    before = weights(learner)
    learner.step([make_rollout(rows=1, environments=1, valid=np.ones((1, 1), np.bool_))], 0.0)
    assert learner.policy_version == 2
    assert learner.metrics.take_means()
    assert not np.array_equal(before["policy_head.weight"], weights(learner)["policy_head.weight"])
    learner.step([make_rollout(rows=1, environments=1, valid=np.zeros((1, 1), np.bool_))], 0.0)
    assert learner.policy_version == 2
    assert learner.metrics.take_means() == {}


def test_memory_with_one_environment_makes_one_version_and_one_optimiser_step_for_each_pass() -> None:
    learner = make_learner(RECURRENT, algorithm="appo", passes=3, minibatches=4)
    learner.step([make_rollout(environments=1, state_size=learner.state_size)], 0.0)
    assert learner.policy_version == 3
    assert learner.state()["adam/steps"] == 3


# ------------------------------------------------------------------------------------- rates and metrics


@pytest.mark.parametrize(
    ("settings", "rates", "bonuses"),
    [
        ({"learning_rate_final": 0.2, "entropy_bonus_final": 1.0}, [0.4, 0.4, 0.35, 0.2, 0.2], [0, 0, 0.25, 1, 1]),
        ({}, [0.4] * 5, [0.0] * 5),
        ({"learning_rate_final": 0.0, "entropy_bonus_final": 0.0}, [0.4, 0.4, 0.3, 0.0, 0.0], [0.0] * 5),
    ],
)
def test_rates_are_annealed_over_the_budget_and_constant_outside(
    settings: dict[str, float], rates: list[float], bonuses: list[float]
) -> None:
    learner = make_learner(**{"learning_rate": 0.4, "entropy_bonus": 0.0, "algorithm": "a2c", **settings})
    shares = (-1.0, 0.0, 0.25, 1.0, 1.5)
    assert [learner.learning_rate(share) for share in shares] == pytest.approx(rates)
    assert [learner.entropy_bonus(share) for share in shares] == pytest.approx(bonuses)


@pytest.mark.parametrize(
    ("settings", "loaded", "value"),
    [
        # Of the valid rows, the mean reward is -3, and a quarter terminate: -3 / (1 - 0.8 * 0.75).
        ({"mean_first_value": True}, 0.0, -7.5),
        ({"mean_first_value": True, "algorithm": "appo"}, 0.0, -7.5),
        ({"mean_first_value": True}, 0.25, 0.25),  # the weights of another run
        ({}, 0.0, 0.0),
    ],
)
def test_values_begin_as_the_mean_over_the_first_batch(settings: dict[str, Any], loaded: float, value: float) -> None:
    learner = make_learner(discount_factor=0.8, learning_rate=1e-9, **settings)
    learner.load({**weights(learner), "value_head.bias": np.array([loaded], np.float32)})
    valid, terminated = np.ones((3, 4), np.bool_), np.zeros((3, 4), np.bool_)
    valid[2], terminated[0, 1], terminated[1, 2] = False, True, True
    rewards = np.repeat(np.array([[-2.0], [-4.0], [100.0]], np.float32), 4, 1)
    for _ in range(2):  # the second batch changes nothing
        rollout = make_rollout(rows=3, environments=4, rewards=rewards, terminated=terminated, valid=valid)
        learner.step([rollout], 0.0)
        assert learner.weights()["value_head.bias"] == pytest.approx([value], abs=1e-4)
        rewards = rewards - 5.0


@pytest.mark.parametrize("algorithm", ["a2c", "impala", "appo"])
def test_same_seed_gives_identical_weights(algorithm: str) -> None:
    def trained(seed: int) -> dict[str, np.ndarray]:
        learner = make_learner(algorithm=algorithm, seed=seed)
        for step in range(STEPS):
            learner.step(make_rollouts(step), 0.0)
        return weights(learner)

    assert_same(trained(3), trained(3))
    assert not np.array_equal(trained(3)["policy_head.weight"], trained(4)["policy_head.weight"])


@pytest.mark.parametrize("policy", [POLICY, RECURRENT], ids=["mlp", "gru"])
@pytest.mark.parametrize("algorithm", ["a2c", "impala", "appo"])
@pytest.mark.parametrize("normalize", [False, True])
def test_content_of_reset_rows_does_not_change_the_weights(algorithm: str, normalize: bool, policy: PolicySpec) -> None:
    clean = make_rollouts(1, state_size=make_learner(policy).state_size)
    assert not all(rollout.valid.all() for rollout in clean)
    garbage = [
        replace(
            rollout,
            actions={ACTION: np.where(rollout.valid[..., None], plain(rollout.actions), 3 - plain(rollout.actions))},
            rewards=np.where(rollout.valid, rollout.rewards, np.float32(1e4)),
            behaviour_log_probs=np.where(rollout.valid, rollout.behaviour_log_probs, np.float32(-20.0)),
        )
        for rollout in clean
    ]
    results = []
    for each in (clean, garbage):
        learner = make_learner(policy, algorithm=algorithm, normalize_advantages=normalize)
        learner.step(each, 0.0)
        results.append((weights(learner), learner.metrics.take_means()))
    assert_same(results[0][0], results[1][0])
    assert results[0][1] == results[1][1]


def test_metrics_are_means_since_the_last_call() -> None:
    apart, together = make_learner(), make_learner()
    taken = []
    for step in range(3):
        apart.step(make_rollouts(step), 0.0)
        taken.append(apart.metrics.take_means())
        together.step(make_rollouts(step), 0.0)
    means = {name: float(np.mean([row[name] for row in taken])) for name in METRICS}
    assert together.metrics.take_means() == pytest.approx(means, rel=1e-5)
    assert together.metrics.take_means() == {}


def test_batches_without_a_metric_do_not_count_in_its_mean() -> None:
    metrics = UpdateMetrics(SPACES, torch.device("cpu"), 1.0)
    terms = Terms(*[torch.zeros(()) for _ in Terms._fields])
    metrics.add_update(terms, torch.ones(()))
    metrics.count_updates(1)
    for explained in (0.5, np.nan, 0.25):
        metrics.add_batch_metrics(torch.tensor([explained, 3.0, 4.0]))
    means = metrics.take_means()
    assert (means["explained_variance"], means["value_mean"]) == (0.375, 3.0)
    metrics.add_update(terms, torch.ones(()))
    metrics.count_updates(1)
    metrics.add_batch_metrics(torch.tensor([np.nan, 3.0, 4.0]))
    assert "explained_variance" not in metrics.take_means()


def test_advantage_std_is_the_standard_deviation_of_the_advantages() -> None:
    # With a discount factor of 0, A = r - V, and V is initially 0 for an observation of 0.
    rewards = torch.linspace(4.0, 6.0, 18).reshape(6, 3).numpy()
    nothing, everything = np.zeros((6, 3), np.bool_), np.ones((6, 3), np.bool_)
    rollout = make_rollout(
        frames=np.zeros((7, 3, 3), np.float32),
        rewards=rewards,
        terminated=nothing,
        truncated=nothing,
        valid=everything,
    )
    learner = make_learner(algorithm="a2c", discount_factor=0.0)
    learner.step([rollout], 0.0)
    assert learner.metrics.take_means()["advantage_std"] == pytest.approx(rewards.std(), rel=1e-4)


def test_action_counts_are_over_batches_since_the_last_call() -> None:
    learner = make_learner()
    assert learner.metrics.take_action_counts() == {ACTION: [0] * 4}
    rollouts = make_rollouts(1) + make_rollouts(2)
    learner.step(rollouts[:2], 0.0)
    learner.step(rollouts[2:], 0.0)
    actions = np.concatenate(
        [plain(rollout.actions)[rollout.valid, 0] for rollout in rollouts]
    )  # reset rows have no action
    assert learner.metrics.take_action_counts() == {ACTION: np.bincount(actions, minlength=4).tolist()}
    assert learner.metrics.take_action_counts() == {ACTION: [0] * 4}


@pytest.mark.parametrize(
    ("shape", "size"), [((2, 5), (2, 15)), ((2, 5, 1), (2, 15)), ((2, 5, 3), (2, 15, 3)), ((5,), None)]
)
def test_observation_image_shows_the_stacked_frames_side_by_side(
    shape: tuple[int, ...], size: tuple[int, ...] | None
) -> None:
    space = ArraySpace(shape=shape, dtype="uint8", frames=3)
    learner = Learner(learner_spec(), POLICY, plain_spaces(space, 4))
    assert learner.metrics.take_observation_image() is None
    frames = np.random.default_rng(0).integers(0, 256, (6 + 3, 3, *shape), np.uint8)
    learner.step([make_rollout(frames=frames)], 0.0)
    picture = learner.metrics.take_observation_image()
    if size is None:
        assert picture is None
        return
    assert picture is not None
    np.testing.assert_array_equal(picture, np.concatenate(list(frames[:3, 0]), axis=1).reshape(size))
    assert learner.metrics.take_observation_image() is None


# --------------------------------------------------------------------------------------------- restarts


def saved(learner: Learner, directory: Path) -> Path:
    encoded = encode_checkpoint(
        spec=run_spec(),
        spaces=SPACES,
        policy_version=learner.policy_version,
        program=b"program",
        parameters=learner.weights(),
        state=learner.state(),
        counters=RunCounters(1).state(0.0),
    )
    return save_checkpoint(directory, encoded, keep=1)


def restored(learner: Learner, directory: Path) -> Learner:
    checkpoint = load_checkpoint(directory)
    learner.restore(checkpoint.policy.policy_version, checkpoint.policy.weights, checkpoint.state)
    return learner


@pytest.mark.parametrize("policy", [POLICY, RECURRENT], ids=["mlp", "gru"])
@pytest.mark.parametrize("algorithm", ["impala", "appo"])
@pytest.mark.parametrize("optimizer", ["adam", "rmsprop"])
def test_restored_learner_continues_identically(
    optimizer: str, algorithm: str, policy: PolicySpec, tmp_path: Path
) -> None:
    settings = {"optimizer": optimizer, "algorithm": algorithm}
    updates = learner_spec(**settings).updates_per_batch

    def learn(learner: Learner, steps: range) -> None:
        for step in steps:
            learner.step(make_rollouts(step, state_size=learner.state_size), step / 10)

    through = make_learner(policy, **settings)
    learn(through, range(10))
    state = {name: value.clone() for name, value in through.state().items()}

    first = make_learner(policy, **settings)
    learn(first, range(5))
    checkpoint = saved(first, tmp_path)
    learn(first, range(99, 100))  # the checkpoint must not share memory with the learner
    second = restored(make_learner(policy, **settings, seed=99), checkpoint)
    assert second.policy_version == 5 * updates
    learn(second, range(5, 10))

    assert second.policy_version == 10 * updates
    assert_same(weights(through), weights(second))
    assert second.state().keys() == state.keys()
    for name, value in second.state().items():  # including the random state, which shuffles the next batch
        assert torch.equal(value, state[name])


def consecutive_rollouts(batch: int, epoch: int = EPOCH, first: int = 0) -> list[Rollout]:
    """Return the rollouts of a batch, which continue those of the batch before: one rollout of each of two actors."""
    return [
        make_rollout(identity(actor, batch - first, epoch=epoch), seed=batch * 100 + number)
        for number, actor in enumerate(("a", "b"))
    ]


@pytest.mark.parametrize("algorithm", ["a2c", "appo"])
def test_restored_learner_continues_its_normalisation_identically(algorithm: str, tmp_path: Path) -> None:
    """Actors begin a new learner epoch with sequence number 0: the first return of each then starts from 0."""
    settings = {"algorithm": algorithm, "normalize_rewards": True, "normalize_advantages": True, "curiosity": 1.0}

    def learn(learner: Learner, batches: range, epoch: int) -> None:
        for batch in batches:
            learner.step(consecutive_rollouts(batch, epoch, batches.start), 0.0)

    through = make_learner(NORMALIZED, **settings)
    learn(through, range(5), EPOCH)
    learn(through, range(5, 10), EPOCH + 1)
    state = {name: value.clone() for name, value in through.state().items()}

    first = make_learner(NORMALIZED, **settings)
    learn(first, range(5), EPOCH)
    checkpoint = saved(first, tmp_path)
    learn(first, range(5, 6), EPOCH)  # the checkpoint must not share memory with the learner
    second = restored(make_learner(NORMALIZED, **settings, seed=99), checkpoint)
    learn(second, range(5, 10), EPOCH + 1)

    assert_same(weights(through), weights(second))
    assert {"observations/observation/mean", "returns/squares", "curiosity/squares"} <= state.keys()
    assert second.state().keys() == state.keys()
    for name, value in second.state().items():
        assert torch.equal(value, state[name]), name
    rows = sum(int(rollout.valid.sum()) for batch in range(10) for rollout in consecutive_rollouts(batch))
    assert state["observations/observation/count"].eq(rows).all()
    assert state["returns/count"] == rows


def test_checkpoint_counts_the_observations_of_its_batch_in_the_weights(tmp_path: Path) -> None:
    """The mean and the scale that actors use are those of all observations so far, also after a restart."""
    learner = make_learner(NORMALIZED, algorithm="a2c")
    learner.step(consecutive_rollouts(0), 0.0)
    again = restored(make_learner(NORMALIZED, algorithm="a2c", seed=9), saved(learner, tmp_path))
    seen = np.concatenate([plain(each.frames)[:-1][each.valid] for each in consecutive_rollouts(0)])
    np.testing.assert_allclose(again.weights()["normalizer.means.0"].sum(0), seen.mean(0), rtol=1e-5)
    np.testing.assert_allclose(again.weights()["normalizer.scales.0"], 1.0 / seen.std(0), rtol=2**-8)


def test_statistics_that_came_with_initial_weights_change_slowly() -> None:
    """A run with --init-from begins with the observations of the other run, not with none."""
    first, second = (make_learner(NORMALIZED, algorithm="a2c", seed=seed) for seed in (1, 2))
    first.step(consecutive_rollouts(0), 0.0)
    second.load(weights(first))
    far = [replace(each, frames={NAME: plain(each.frames) + 100.0}) for each in consecutive_rollouts(1)]
    second.step(far, 0.0)
    before, after = (weights(each)["normalizer.means.0"].sum(0) for each in (first, second))
    np.testing.assert_allclose(after, before, atol=0.2)


def test_restore_refuses_a_checkpoint_without_the_statistics_of_rewards(tmp_path: Path) -> None:
    checkpoint = saved(make_learner(), tmp_path)
    with pytest.raises(CheckpointMismatchError, match=r"lacks the statistics 'returns/.*training.normalize_rewards"):
        restored(make_learner(normalize_rewards=True), checkpoint)


def test_random_state_is_restored(tmp_path: Path) -> None:
    learner = make_learner()
    checkpoint = saved(learner, tmp_path)
    expected = torch.rand(4)
    restored(make_learner(seed=9), checkpoint)
    assert torch.equal(torch.rand(4), expected)


def test_restore_refuses_parameters_of_another_network(tmp_path: Path) -> None:
    checkpoint = saved(make_learner(), tmp_path)
    for other, difference in (
        (PolicySpec(hidden=(9,)), r"the weights 'encoder.layers.0.weight' are \(8, 3\) in the checkpoint and \(9, 3\)"),
        (RECURRENT, r"the checkpoint has no weights 'memory.+', which this run's network has"),
        (PolicySpec(hidden=(8, 8)), "the checkpoint has no weights 'encoder.layers.2.weight'"),
    ):
        with pytest.raises(CheckpointMismatchError, match=difference):
            restored(make_learner(other), checkpoint)
    recurrent = saved(make_learner(RECURRENT.model_copy(update={"hidden": (8,)})), tmp_path)
    with pytest.raises(CheckpointMismatchError, match=r"has weights 'memory.+', which this run's network lacks|are \("):
        restored(make_learner(), recurrent)


@pytest.mark.parametrize(("wrote", "reads"), [("rmsprop", "adam"), ("adam", "rmsprop")])
def test_restore_refuses_statistics_of_another_optimiser(wrote: str, reads: str, tmp_path: Path) -> None:
    checkpoint = saved(make_learner(optimizer=wrote), tmp_path)
    with pytest.raises(CheckpointMismatchError, match=r"lacks the statistics .*: restore training.optimizer"):
        restored(make_learner(optimizer=reads), checkpoint)


# -------------------------------------------------------------------------- gradients that are not finite


@pytest.mark.parametrize("algorithm", ["a2c", "impala", "appo"])
@pytest.mark.parametrize("reward", [np.inf, np.nan])
def test_update_is_skipped_and_counted_when_its_gradient_is_not_finite(algorithm: str, reward: float) -> None:
    """Intake rejects such rewards, but an algorithm of the user may have a loss that is not finite."""
    learner = make_learner(algorithm=algorithm, passes=2, minibatches=1)
    learner.step(make_rollouts(1), 0.0)
    learner.metrics.take_means()
    before, state, version = weights(learner), learner.state(), learner.policy_version
    state = {name: value.clone() for name, value in state.items()}
    rewards = np.full_like(make_rollout().rewards, reward)
    learner.step([make_rollout(rewards=rewards)], 0.0)
    assert learner.updates_skipped == learner.policy_version - version > 0
    assert_same(weights(learner), before)
    after = learner.state()
    for name in state.keys() - {"torch_random_state"}:
        assert_close(after[name], state[name], rtol=0, atol=0)
    assert learner.metrics.take_means() == {}
    skipped = learner.updates_skipped
    learner.step(make_rollouts(2), 0.0)
    assert learner.updates_skipped == skipped
    assert all(np.isfinite(array).all() for array in learner.weights().values())
    assert all(np.isfinite(value) for value in learner.metrics.take_means().values())


# ------------------------------------------------------------------------------------------- diagnostics


@pytest.mark.parametrize("kind", ["a2c", "impala", "appo"])
def test_diagnostics_are_those_of_the_newest_batch_before_its_first_update(kind: str) -> None:
    learner = make_learner(algorithm=kind, rho_clip=1.25, learning_rate=0.1)
    start = weights(learner)
    rollouts = make_rollouts(4)
    ratios = np.exp(learned_log_probs(start, rollouts) - join(rollouts).behaviour_log_probs.numpy())
    ratios = ratios[join(rollouts).valid.numpy() > 0]
    learner.step(rollouts, 0.0)
    measured = learner.take_diagnostics()
    assert measured["rho_mean"] == pytest.approx(ratios.mean(), rel=1e-4)
    assert measured["behaviour_kl"] == pytest.approx((ratios - 1 - np.log(ratios)).mean(), rel=1e-4)
    assert measured["rho_effective_share"] == pytest.approx(
        ratios.sum() ** 2 / (len(ratios) * (ratios**2).sum()), rel=1e-4
    )
    assert measured.get("rho_clipped_fraction") == (pytest.approx((ratios > 1.25).mean()) if kind == "impala" else None)
    assert measured["value_error_p05"] < measured["value_error_p50"] < measured["value_error_p95"]
    assert learner.take_diagnostics() == {}


def learned_log_probs(start: dict[str, np.ndarray], rollouts: list[Rollout]) -> np.ndarray:
    """Return log pi(a_t | s_t) of the policy with these weights, [T, B]."""
    return join(on_policy(POLICY, start, rollouts)).behaviour_log_probs.numpy()


def test_diagnostics_on_policy_show_no_difference() -> None:
    learner = make_learner(algorithm="impala")
    learner.step(on_policy(POLICY, weights(learner), make_rollouts(1)), 0.0)
    measured = learner.take_diagnostics()
    assert measured["behaviour_kl"] == pytest.approx(0.0, abs=1e-6)
    assert measured["rho_effective_share"] == pytest.approx(1.0, abs=1e-6)


def test_value_error_quantiles_are_of_targets_minus_values() -> None:
    learner = make_learner(algorithm="a2c", discount_factor=0.0)  # the target of a row is its reward
    with torch.no_grad():
        learner._parameters["value_head.weight"].zero_()
        learner._parameters["value_head.bias"].fill_(2.0)
    rollouts = make_rollouts(2)
    batch = join(rollouts)
    errors = (batch.rewards - 2.0)[batch.valid > 0].numpy()
    learner.step(rollouts, 0.0)
    measured = learner.take_diagnostics()
    assert measured["value_error_p05"] == pytest.approx(np.quantile(errors, 0.05), rel=1e-4)
    assert measured["value_error_p95"] == pytest.approx(np.quantile(errors, 0.95), rel=1e-4)


@pytest.mark.parametrize(("bound", "share"), [(1e9, 0.0), (1e-9, 1.0)])
def test_share_of_clipped_gradients_is_over_the_updates_since_the_last_row(bound: float, share: float) -> None:
    learner = make_learner(algorithm="appo", max_gradient_norm=bound)
    learner.step(make_rollouts(1), 0.0)
    assert learner.metrics.take_means()["gradient_clipped_fraction"] == share


def test_share_of_clipped_gradients_counts_updates() -> None:
    metrics = UpdateMetrics(SPACES, torch.device("cpu"), 1.0)
    terms = Terms(*[torch.zeros(()) for _ in Terms._fields])
    for norm in (2.0, 1.0, 0.5, 9.0, 0.0):
        metrics.add_update(terms, torch.tensor(norm))
    metrics.count_updates(5)
    assert metrics.take_means()["gradient_clipped_fraction"] == 0.4
    metrics.add_update(terms, torch.tensor(1.5))
    metrics.count_updates(1)
    assert metrics.take_means()["gradient_clipped_fraction"] == 1.0


def test_checkpoints_of_earlier_releases_have_one_count_for_all_numbers(tmp_path: Path) -> None:
    learner = make_learner(NORMALIZED, algorithm="a2c", normalize_rewards=True)
    learner.step(consecutive_rollouts(0), 0.0)
    state = learner.state()
    count = state["observations/observation/count"][0].clone()
    again = make_learner(NORMALIZED, algorithm="a2c", normalize_rewards=True, seed=9)
    again.restore(1, weights(learner), {**state, "observations/observation/count": count})
    for name, value in again.state().items():
        assert torch.equal(value, state[name]), name


def test_reset_statistics_are_defined_by_the_next_rollouts() -> None:
    learner = make_learner(NORMALIZED, algorithm="a2c", normalize_rewards=True)
    spoiled = [replace(each, frames={NAME: plain(each.frames) * 1e6}) for each in consecutive_rollouts(0)]
    learner.step(spoiled, 0.0)
    learner.reset_statistics()
    assert not learner.state()["returns/count"]
    assert (learner.weights()["normalizer.scales.0"] == 1.0).all()
    learner.step(consecutive_rollouts(1), 0.0)
    assert (learner.weights()["normalizer.scales.0"] > 0.1).all()


# ---------------------------------------------------------------------------------- rollouts far outside the others

FAR: dict[str, dict[str, Any]] = {
    "observations/observation": {"frames": {NAME: np.full((7, 3, 3), -9e14, np.float32)}},
    "returns": {"rewards": np.full((6, 3), 1e9, np.float32)},
}


def of_actors(batch: int, **replaced: Any) -> list[Rollout]:
    """Return a rollout of each of a, b and z, of which the last has something replaced."""
    rollouts = [make_rollout(identity(name, batch), seed=3 * batch + number) for number, name in enumerate("abz")]
    return [*rollouts[:2], replace(rollouts[2], **replaced)]


@pytest.mark.parametrize("normalized", [True, False])
@pytest.mark.parametrize("component", FAR)
def test_a_rollout_far_outside_those_of_other_actors_is_left_out_and_named(component: str, normalized: bool) -> None:
    policy, settings = (NORMALIZED, {"normalize_rewards": True}) if normalized else (POLICY, {})
    ours, theirs = (make_learner(policy, algorithm="a2c", **settings) for _ in range(2))
    for batch in range(3):
        for learner in (ours, theirs):
            learner.step(of_actors(batch), 0.0)
    bad = of_actors(3, **FAR[component])
    assert ours.step(bad, 0.0) == []
    name = component if normalized or component != "returns" else "rewards"
    assert ours.far_outside == {bad[2]: name}
    theirs.step(bad[:2], 0.0)
    assert_same(weights(ours), weights(theirs))
    ours.step(of_actors(4), 0.0)
    assert ours.far_outside == {}
    assert ours.updates_skipped == 0


def test_a_single_actor_is_never_far_outside() -> None:
    learner = make_learner(NORMALIZED, algorithm="a2c", normalize_rewards=True)
    for sequence in range(6):
        bad = FAR["returns"] | FAR["observations/observation"] if sequence >= 3 else {}
        learner.step([replace(make_rollout(identity("a", sequence), seed=sequence), **bad)], 0.0)
        assert learner.far_outside == {}
    assert learner.updates_skipped == 0


def test_rewards_that_nobody_confirms_count_little_in_the_batch() -> None:
    """Clipped to 10 deviations, rewards of a thousand would still decide the advantages of the whole batch."""
    learner = make_learner(NORMALIZED, algorithm="a2c", normalize_rewards=True, learning_rate=1e-9)
    losses = []
    for batch in range(8):
        bad = {"rewards": np.full((6, 3), 1e4, np.float32)} if batch == 7 else {}
        learner.step(of_actors(batch, **bad), 0.0)
        losses.append(learner.metrics.take_means()["value_loss"])
    assert losses[-1] < 60 * max(losses[:-1])
