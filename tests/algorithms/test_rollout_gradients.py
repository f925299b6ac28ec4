"""algorithms/rollout_gradients.py: what actors compute is what the learner would compute from their rollouts."""

from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from building import ENVIRONMENTS, ROWS, SPACES, identity, make_rollout, run_spec

from daedalus.algorithms.algorithm import Losses
from daedalus.algorithms.batch import Batch
from daedalus.algorithms.forward import Forward
from daedalus.algorithms.gradient_inputs import NAME as GRADIENT_INPUTS
from daedalus.algorithms.gradient_inputs import GradientInputs, packed, unpacked
from daedalus.algorithms.gradients import Terms
from daedalus.algorithms.policy_gradient import PolicyGradient
from daedalus.algorithms.rollout_gradients import RolloutGradients
from daedalus.learner.serving.upload_checks import gradient_violation, restored
from daedalus.learner.training.learner import Learner
from daedalus.policy.acting.program_check import PolicyError
from daedalus.policy.user_modules import UserModules
from daedalus.protocol.algorithms import AlgorithmRecord
from daedalus.protocol.codec import decode, encode
from daedalus.protocol.compact import bfloat16, bits_of, float32
from daedalus.protocol.limits import Limits
from daedalus.protocol.spec import RunSpec
from daedalus.protocol.uploads import DIAGNOSTICS, LARGEST_GRADIENT_NORM, LOSS_TERMS, Gradient, Rollout

NORMALISED: dict[str, Any] = {"normalize_rewards": True, "normalize_advantages": True}
ANNEALED: dict[str, Any] = {"entropy_bonus": 0.1, "entropy_bonus_final": 0.0}


def spec_of(algorithm: str = "a2c", memory: str = "none", **training: Any) -> RunSpec:
    content = run_spec(algorithm=algorithm, **training).model_dump()
    content["policy"] |= {"normalize_observations": True, "memory": memory, "memory_units": 5}
    content["collection"]["upload"] = "gradients"
    return RunSpec.model_validate(content)


def learner_of(spec: RunSpec) -> Learner:
    return Learner(spec.training, spec.policy, SPACES)


def sent(gradients: RolloutGradients, rollout: Rollout) -> Gradient:
    """Return the gradient of a rollout as the learner receives it."""
    message = decode(encode(gradients.compute(rollout)), Limits())
    assert isinstance(message, Gradient)
    return message


def played(actor: str, sequence: int, state_size: int = 0) -> Rollout:
    return make_rollout(identity(actor, sequence), seed=100 * ord(actor) + sequence, state_size=state_size)


def snapshot(learner: Learner, progress: float = 0.0) -> dict[str, np.ndarray]:
    return {name: values.copy() for name, values in learner.weights().items()} | learner.gradient_inputs(progress)


class NothingWithoutRows(PolicyGradient):
    """Makes no update of a batch without rows to learn from."""

    record = AlgorithmRecord(synchronous=True)

    def losses(self, batch: Batch, forward: Forward) -> Iterator[Losses]:
        return super().losses(batch, forward) if batch.valid.any() else iter(())


def test_rollout_of_which_an_own_algorithm_makes_no_update_has_a_gradient_of_0() -> None:
    name, modules = f"{__name__}:NothingWithoutRows", UserModules(frozenset({__name__}))
    spec = spec_of(name, algorithm_record=NothingWithoutRows.record.model_dump())
    learner = Learner(spec.training, spec.policy, SPACES, modules)
    gradients = RolloutGradients(spec.learning, SPACES, modules)
    gradients.load(snapshot(learner))
    rollout = played("a", 0)
    assert any(values.any() for values in sent(gradients, rollout).gradient.values())
    none = np.zeros_like(rollout.valid)
    empty = replace(rollout, valid=none, terminated=none, truncated=none)
    assert not any(values.any() for values in sent(gradients, empty).gradient.values())


@pytest.mark.parametrize("memory", ["none", "gru"])
@pytest.mark.parametrize(("optimizer", "epsilon"), [("adam", 0.0), ("rmsprop", 0.0), ("rmsprop", 0.3)])
def test_gradients_of_single_rollouts_make_the_updates_of_the_rollouts_to_the_bit(
    memory: str, optimizer: str, epsilon: float
) -> None:
    """Two actors take turns: each needs the statistics of the returns of both, which snapshots bring."""
    spec = spec_of(memory=memory, optimizer=optimizer, exploration=(epsilon,), **NORMALISED, **ANNEALED)
    by_rollouts, by_gradients = learner_of(spec), learner_of(spec)
    actors = {name: RolloutGradients(spec.learning, SPACES) for name in "ab"}
    for turn in range(4):
        name, progress = "ab"[turn % 2], turn / 4
        actor, rollout = actors[name], played(name, turn // 2, by_rollouts.state_size)
        actor.load(snapshot(by_gradients, progress))
        by_gradients.apply([sent(actor, rollout)], progress)
        assert by_rollouts.step([rollout], progress) == []
        for name, values in by_rollouts.weights().items():
            assert np.array_equal(by_gradients.weights()[name], values), name
        for name, values in by_rollouts.state().items():  # with the running statistics and those of the optimiser
            assert torch.equal(by_gradients.state()[name], values), name
        assert by_gradients.metrics.take_means() == by_rollouts.metrics.take_means()
        assert by_gradients.metrics.take_action_counts() == by_rollouts.metrics.take_action_counts()
        assert by_gradients.take_diagnostics() == by_rollouts.take_diagnostics()
    assert by_gradients.policy_version == 4


def test_the_mean_of_gradients_is_the_gradient_of_the_batch() -> None:
    """Each valid row counts once, however many its rollout has; the statistics are those of all rows."""
    spec = spec_of(normalize_rewards=True)
    by_rollouts, by_gradients = learner_of(spec), learner_of(spec)
    actors = {name: RolloutGradients(spec.learning, SPACES) for name in "ab"}
    rollouts = [played("a", 0), played("b", 0)]
    assert rollouts[0].env_steps != rollouts[1].env_steps
    by_rollouts.step(rollouts, 0.0)
    for actor in actors.values():
        actor.load(snapshot(by_gradients))
        assert actor._rewards is not None  # the same statistics as the batch's, so that the gradients are comparable
        actor._rewards.moments.count.copy_(by_rollouts._rewards.moments.count)  # type: ignore[union-attr]
        actor._rewards.moments.squares.copy_(by_rollouts._rewards.moments.squares)  # type: ignore[union-attr]
        actor._rewards.moments.merge = lambda _: None  # type: ignore[method-assign]
    by_gradients.apply([sent(actors[each.identity.actor], each) for each in rollouts], 0.0)
    assert by_gradients.metrics.take_means() == pytest.approx(
        by_rollouts.metrics.take_means(), rel=0.3, abs=0.2
    )  # means of means: only the gradient's norm is that of the batch
    for name, values in by_rollouts.state().items():
        np.testing.assert_allclose(by_gradients.state()[name], values, rtol=1e-4, atol=1e-9, err_msg=name)


def test_statistics_of_several_actors_are_those_of_all_their_rows() -> None:
    spec = spec_of(normalize_rewards=True)
    by_rollouts, by_gradients = learner_of(spec), learner_of(spec)
    actors = {name: RolloutGradients(spec.learning, SPACES) for name in "abc"}
    for sequence in range(3):
        rollouts = [played(name, sequence) for name in actors]
        gradients = []
        for rollout in rollouts:
            actors[rollout.identity.actor].load(snapshot(by_gradients))
            gradients.append(sent(actors[rollout.identity.actor], rollout))
        by_gradients.apply(gradients, 0.0)
        by_rollouts.step(rollouts, 0.0)
    for name, values in by_rollouts.state().items():
        if name.startswith(("observations/", "returns/")):
            np.testing.assert_allclose(by_gradients.state()[name], values, rtol=1e-12, err_msg=name)


def test_what_rounding_loses_is_sent_with_later_gradients() -> None:
    spec = spec_of("a3c")
    learner, compact = learner_of(spec), RolloutGradients(spec.learning, SPACES)
    exact = RolloutGradients(spec_of("a2c").learning, SPACES)
    wanted: dict[str, np.ndarray] = {}
    received: dict[str, np.ndarray] = {}
    once: dict[str, np.ndarray] = {}
    for sequence in range(40):
        rollout = played("a", sequence)
        for actor in (compact, exact):
            actor.load(snapshot(learner))
        message = sent(compact, rollout)
        assert all(values.dtype == np.uint8 for values in message.gradient.values())
        plain = float32(bits_of(message.gradient, None))
        for name, values in sent(exact, rollout).gradient.items():
            wanted[name] = wanted.get(name, 0.0) + values.astype(np.float64)
            received[name] = received.get(name, 0.0) + plain[name].astype(np.float64)
            once[name] = once.get(name, 0.0) + float32(bfloat16({name: values}))[name].astype(np.float64)
    with_feedback, without = (
        max(float(np.abs(sums[name] - wanted[name]).max()) for name in wanted) for sums in (received, once)
    )
    assert with_feedback < without / 2
    assert with_feedback < 0.005


def test_a_gradient_that_is_rejected_does_not_spoil_the_next() -> None:
    spec = spec_of("a3c")
    actor, learner = RolloutGradients(spec.learning, SPACES), learner_of(spec)
    actor.load(snapshot(learner))
    huge = make_rollout(identity(), rewards=np.full((ROWS, ENVIRONMENTS), 1e30, np.float32))
    spoilt, later = sent(actor, huge), sent(actor, played("a", 1))
    assert restored(spoilt).norm > LARGEST_GRADIENT_NORM
    assert restored(later).norm < 100.0


def test_the_message_holds_what_the_metrics_need() -> None:
    spec = spec_of()
    actor = RolloutGradients(spec.learning, SPACES)
    actor.load(snapshot(learner_of(spec)))
    rollout = played("a", 0)
    message = sent(actor, rollout)
    assert Terms._fields == LOSS_TERMS
    assert tuple(message.metrics) == (*LOSS_TERMS, *DIAGNOSTICS)
    assert message.env_steps == np.count_nonzero(rollout.valid) == message.action_counts["action"].sum()
    assert message.identity == rollout.identity
    np.testing.assert_array_equal(message.episode_returns, rollout.episode_returns)


@pytest.mark.parametrize("numbers", [(0.0, 0.0, 0.0, 0.0), (0.01, 1e9 + 1, -np.pi * 1e7, np.e * 1e12), (1 / 3,) * 4])
def test_numbers_survive_compact_snapshots_exactly(numbers: tuple[float, float, float, float]) -> None:
    array = packed(GradientInputs(*numbers))
    assert unpacked(float32(bfloat16({"": array}))[""]) == numbers


def test_weights_that_do_not_fit_are_refused() -> None:
    spec = spec_of()
    actor, weights = RolloutGradients(spec.learning, SPACES), snapshot(learner_of(spec))
    for wrong, reason in (
        ({name: values for name, values in weights.items() if name != "value_head.bias"}, "lacks the weights 'value_h"),
        (weights | {"value_head.bias": np.zeros(2, np.float32)}, "the network requires"),
        ({name: values for name, values in weights.items() if name != GRADIENT_INPUTS}, "no numbers to compute"),
        (weights | {GRADIENT_INPUTS: np.zeros(3, np.float32)}, "no numbers to compute"),
    ):
        with pytest.raises(PolicyError, match=reason):
            actor.load(wrong)


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_an_actor_recovers_from_a_reward_that_is_not_finite(bad: float) -> None:
    """Without a new snapshot, too: the learner makes none while it rejects every gradient."""
    spec = spec_of(algorithm="a3c", normalize_rewards=True)
    learner = learner_of(spec)
    actor = RolloutGradients(spec.learning, SPACES)
    actor.load(snapshot(learner))
    rewards = played("a", 0).rewards.copy()
    rewards[-1, :] = bad
    rollouts = [replace(played("a", 0), rewards=rewards), played("a", 1), played("a", 2)]
    violations = [
        gradient_violation(restored(sent(actor, each)), spec, learner.gradient_shapes, SPACES, ENVIRONMENTS)
        for each in rollouts
    ]
    assert "not finite" in violations[0]
    assert violations[1:] == ["", ""]


def test_a_gradient_of_equal_targets_has_no_explained_variance() -> None:
    spec = spec_of(algorithm="a3c", discount_factor=0.0)  # the target of a row is its reward
    by_rollouts, by_gradients = learner_of(spec), learner_of(spec)
    actor = RolloutGradients(spec.learning, SPACES)
    actor.load(snapshot(by_gradients))
    rollout = replace(played("a", 0), rewards=np.full_like(played("a", 0).rewards, 0.7))
    gradient = restored(sent(actor, rollout))
    assert gradient_violation(gradient, spec, by_gradients.gradient_shapes, SPACES, ENVIRONMENTS) == ""
    by_gradients.apply([gradient], 0.0)
    by_rollouts.step([rollout], 0.0)
    for learner in (by_rollouts, by_gradients):
        means = learner.metrics.take_means()
        assert "explained_variance" not in means
        assert means["value_mean"] != 0.0
