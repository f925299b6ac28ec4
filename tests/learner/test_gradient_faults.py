"""Rollouts without a finite gradient: they are found and left out, and their senders are quarantined."""

from typing import Any

import numpy as np
import pytest
import torch
from building import (
    ENVIRONMENTS,
    POLICY,
    RECURRENT,
    ROWS,
    SPACES,
    identity,
    joined_fleet,
    make_rollout,
    run_context,
)

from daedalus.algorithms.action_values import ActionValues
from daedalus.learner.serving.actor_state import NON_FINITE, Actor
from daedalus.learner.serving.rollout_intake import RolloutIntake
from daedalus.learner.training.learner import Learner
from daedalus.protocol.spec import PolicySpec, TrainingSpec
from daedalus.protocol.uploads import Rollout

RELU = PolicySpec(hidden=(8,), activation="relu")
HUGE_REWARDS: dict[str, Any] = {"rewards": np.full((ROWS, ENVIRONMENTS), np.inf, np.float32)}
HUGE_FRAMES: dict[str, Any] = {"frames": np.full((ROWS + 1, ENVIRONMENTS, 3), 1e30, np.float32)}


def rollout(actor: str, state_size: int = 0, **replaced: Any) -> Rollout:
    return make_rollout(identity(actor), seed=ord(actor), state_size=state_size, **replaced)


def senders(rollouts: list[Rollout]) -> list[str]:
    return [each.identity.actor for each in rollouts]


@pytest.mark.parametrize(
    ("algorithm", "policy", "huge"),
    [
        ("a2c", RELU, HUGE_FRAMES),
        ("a3c", POLICY, HUGE_REWARDS),
        ("impala", RECURRENT, HUGE_REWARDS),
        ("appo", RELU, HUGE_REWARDS),
        ("appo", RECURRENT, HUGE_REWARDS),
    ],
)
def test_rollouts_without_a_finite_gradient_are_left_out(
    algorithm: str, policy: PolicySpec, huge: dict[str, Any]
) -> None:
    learner = Learner(TrainingSpec.model_validate({"algorithm": algorithm}), policy, SPACES)
    size = learner.state_size
    batch = [rollout("a", size), rollout("b", size, **huge), rollout("c", size), rollout("d", size, **huge)]
    assert senders(learner.step(batch, 0.0)) == ["b", "d"]
    assert learner.updates_skipped == 0
    assert learner.policy_version == learner_updates(algorithm)
    assert all(np.isfinite(array).all() for array in learner.weights().values())


def learner_updates(algorithm: str) -> int:
    return TrainingSpec.model_validate({"algorithm": algorithm}).updates_per_batch


@pytest.mark.parametrize("policy", [RELU, RECURRENT])
def test_update_equals_that_of_a_batch_without_the_rollouts_left_out(policy: PolicySpec) -> None:
    learners = [Learner(TrainingSpec(algorithm="a2c"), policy, SPACES) for _ in range(2)]
    size = learners[0].state_size
    good = [rollout("a", size), rollout("c", size)]
    learners[0].step([good[0], rollout("b", size, **HUGE_REWARDS), good[1]], 0.0)
    learners[1].step(good, 0.0)
    assert learners[0].policy_version == learners[1].policy_version == 1
    for name, array in learners[0].weights().items():
        np.testing.assert_array_equal(array, learners[1].weights()[name])
    for name, value in learners[0].state().items():
        assert torch.equal(value, learners[1].state()[name])


def test_a_repeated_update_has_its_own_version(monkeypatch: pytest.MonkeyPatch) -> None:
    versions: list[int] = []
    monkeypatch.setattr(ActionValues, "after_update", lambda _self, version, _forward: versions.append(version))
    learner = Learner(TrainingSpec(algorithm="one_step_q"), POLICY, SPACES)
    for _ in range(3):
        learner.step([rollout("a"), rollout("b", **HUGE_REWARDS)], 0.0)
    assert versions == [1, 2, 3]


@pytest.mark.parametrize(("algorithm", "updates"), [("a2c", 1), ("appo", 12)])
def test_updates_are_skipped_if_all_rollouts_are_at_fault(algorithm: str, updates: int) -> None:
    learner = Learner(TrainingSpec.model_validate({"algorithm": algorithm}), RELU, SPACES)
    before = {name: array.copy() for name, array in learner.weights().items()}
    batch = [rollout("a", **HUGE_REWARDS), rollout("b", **HUGE_REWARDS)]
    assert senders(learner.step(batch, 0.0)) == ["a", "b"]
    assert learner.policy_version == learner.updates_skipped == updates
    for name, array in learner.weights().items():
        np.testing.assert_array_equal(array, before[name])


def test_a_batch_that_was_left_out_has_no_diagnostics() -> None:
    """Those of the batch before are not left either: its memory was used for the new one."""
    learner = Learner(TrainingSpec(algorithm="impala"), RELU, SPACES)
    learner.step([rollout("a")], 0.0)
    learner.step([rollout("a", **HUGE_REWARDS)], 0.0)
    assert learner.updates_skipped == 1
    assert learner.take_diagnostics() == {}
    learner.step([rollout("a")], 0.0)
    assert learner.take_diagnostics()


def test_versions_are_as_many_as_expected_if_few_rows_are_left() -> None:
    """A batch of one row makes fewer minibatches, but actors and counters expect the versions of the whole batch."""
    learner = Learner(TrainingSpec(algorithm="appo", passes=2, minibatches=4), RELU, SPACES)
    one = np.zeros((ROWS, ENVIRONMENTS), np.bool_)
    one[0, 0] = True
    learner.step([rollout("a", valid=one), rollout("b", **HUGE_REWARDS)], 0.0)
    assert (learner.policy_version, learner.updates_skipped) == (8, 0)


def test_no_sender_is_at_fault_if_the_parameters_are() -> None:
    learner = Learner(TrainingSpec(algorithm="appo"), RELU, SPACES)
    for array in learner.weights().values():
        array.fill(1e30)  # the arrays share memory with the parameters
    assert learner.step([rollout("a"), rollout("b")], 0.0) == []
    assert learner.updates_skipped == learner.policy_version == 12


# ---------------------------------------------------------------------------------------------- the senders


def test_actor_is_quarantined_after_three_rollouts_at_fault() -> None:
    actor = Actor("a")
    for _ in range(2):
        actor.count_trained(NON_FINITE)
    assert not actor.quarantined
    actor.count_trained(NON_FINITE)
    assert actor.quarantined.startswith("3 of its rollouts had no finite gradient")
    assert actor.rejected == {"non_finite": 3}


def test_few_good_rollouts_in_between_do_not_prevent_the_quarantine() -> None:
    """Each such rollout costs the learner much time: a sender of one in ten must not go on for ever."""
    actor = Actor("a")
    for _ in range(3):
        actor.count_trained(NON_FINITE)
        for _ in range(99):
            actor.count_trained()
    assert actor.quarantined


def test_a_hundred_good_rollouts_make_up_for_the_rollouts_at_fault() -> None:
    actor = Actor("a")
    for _ in range(5):
        for _ in range(2):
            actor.count_trained(NON_FINITE)
        for _ in range(100):
            actor.count_trained()
    assert not actor.quarantined


def test_new_incarnation_starts_with_a_clean_record() -> None:
    actor = Actor("a")
    for _ in range(2):
        actor.count_trained(NON_FINITE)
    actor.start_incarnation(2)
    actor.count_trained(NON_FINITE)
    assert not actor.quarantined


def test_rollouts_at_fault_are_counted_for_their_senders_and_the_run() -> None:
    context = run_context(fleet=joined_fleet("a", "b"))
    fleet, counters, intake = context.fleet, context.counters, RolloutIntake(context, lambda: 0)
    batch = [rollout("a"), rollout("b"), make_rollout(identity("b", incarnation=9)), rollout("z")]
    for _ in range(2):
        intake.count_trained(batch, [batch[1], batch[3]])
    intake.count_trained([], [batch[1], batch[3]])  # of an earlier batch
    assert counters.rollouts_rejected == {"non_finite": 6}
    assert fleet.live == {"a"}
    assert not fleet.actors["a"].rejected
    assert fleet.actors["b"].rejected == {"non_finite": 3}
    found = [(event.kind, event.actor, event.count) for event in context.events.report()]
    assert found == [("rejected", "b", 3), ("rejected", "z", 3), ("quarantined", "b", 1)]
