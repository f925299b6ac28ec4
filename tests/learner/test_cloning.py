"""Behaviour cloning with appo: before training, and as a term of the loss that fades."""

from typing import Any

import numpy as np
import pytest
import torch
from building import identity, make_rollout

from daedalus.algorithms.replay_buffer import ReplayBuffer
from daedalus.learner.training.learner import Learner
from daedalus.protocol.spaces import ArraySpace, ContinuousSpace, DiscreteSpace, Spaces
from daedalus.protocol.spec import PolicySpec, TrainingSpec
from daedalus.protocol.uploads import Rollout

SPACES = Spaces(
    observations={"observation": ArraySpace(shape=(3,), dtype="float32")},
    actions={"turn": DiscreteSpace(counts=(4, 3)), "push": ContinuousSpace(low=(-1.0,), high=(1.0,))},
)
ROWS, ENVIRONMENTS = 20, 4


def shown(seed: int) -> Rollout:
    """Return a rollout whose actions follow from the observations."""
    frames = np.random.default_rng(seed).normal(5.0, 3.0, (ROWS + 1, ENVIRONMENTS, 3)).astype(np.float32)
    first, second = frames[:-1, :, 0], frames[:-1, :, 1]
    actions = {
        "turn": np.stack([np.where(first > 5.0, 3, 1), np.where(second > 5.0, 0, 2)], -1).astype(np.uint8),
        "push": np.where(first > 5.0, 0.5, -0.5)[..., None].astype(np.float32),
    }
    replaced: dict[str, Any] = {"frames": {"observation": frames}, "actions": actions}
    return make_rollout(identity(sequence=seed), rows=ROWS, environments=ENVIRONMENTS, seed=seed, **replaced)


def learner_of(**training: Any) -> Learner:
    spec = TrainingSpec.model_validate({"algorithm": "appo", "learning_rate": 0.01, **training})
    return Learner(spec, PolicySpec(hidden=(16,), normalize_observations=True), SPACES)


def demonstrations(rollouts: int = 6) -> ReplayBuffer:
    buffer = ReplayBuffer(SPACES, ROWS, ROWS * ENVIRONMENTS * rollouts)
    for seed in range(rollouts):
        buffer.add(shown(seed))
    return buffer


def test_the_policy_imitates_what_it_is_shown_before_the_first_update() -> None:
    learner = learner_of(cloning_updates=300)
    learner.learn_from(demonstrations())
    words = learner.clone().split()
    before, after = float(words[-4]), float(words[-2])
    assert after > before + 1.5  # of actions that it did not learn from
    assert learner.policy_version == 0
    assert learner_of(cloning_updates=300).clone() == ""  # nothing is shown


def test_the_held_out_actions_may_be_more_than_a_minibatch() -> None:
    learner = learner_of(cloning_updates=1)
    learner.learn_from(demonstrations(rollouts=67))  # 419 are held out: two parts of unequal sizes
    assert "held out" in learner.clone()


def test_the_imitation_ends_when_the_run_is_stopped() -> None:
    learner, answers = learner_of(cloning_updates=300), iter([True, True, False])
    learner.learn_from(demonstrations())
    assert learner.clone(lambda: next(answers)) == ""


@pytest.mark.parametrize(("progress", "changes"), [(0.0, True), (0.5, True), (1.0, False)])
def test_the_term_of_the_loss_fades(progress: float, changes: bool) -> None:
    weights = []
    for is_shown in (False, True):
        learner = learner_of(cloning_weight=0.5, passes=1, minibatches=1)
        if is_shown:
            learner.learn_from(demonstrations())
        torch.manual_seed(2)
        learner.step([shown(9)], progress)
        weights.append(np.concatenate([values.ravel() for values in learner.weights().values()]))
    assert (weights[0] != weights[1]).any() == changes
