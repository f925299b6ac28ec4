"""Behaviour cloning with appo: before training, and as a term of the loss that fades."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from building import identity, make_rollout

from daedalus.algorithms.forward import FlatParameters, Forward
from daedalus.algorithms.replay_buffer import ReplayBuffer
from daedalus.learner.training.demonstrations import Cloning
from daedalus.learner.training.learner import Learner
from daedalus.policy.network.actor_critic import ActorCritic
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


MEMORY = PolicySpec(hidden=(8,), memory="gru", memory_units=8)
CUE = Spaces(
    observations={"observation": ArraySpace(shape=(2,), dtype="float32")},
    actions={"action": DiscreteSpace(counts=(2,))},
)


def cues(lengths: list[int]) -> ReplayBuffer:
    """Return episodes that show at their first step only what all their actions are."""
    total = sum(lengths) + len(lengths)  # with the row between two episodes
    columns = -(-total // ROWS)
    frames = np.random.default_rng(1).normal(0.0, 0.3, (columns * ROWS + 1, 2)).astype(np.float32)
    actions, valid = np.zeros(columns * ROWS, np.uint8), np.zeros(columns * ROWS, np.bool_)
    first = 0
    for number, length in enumerate(lengths):
        frames[first, 0] = cue = 3.0 if number % 2 else -3.0
        actions[first : first + length], valid[first : first + length] = cue > 0.0, True
        first += length + 1
    buffer = ReplayBuffer(CUE, ROWS, columns * ROWS)
    rollout = make_rollout(identity(), rows=ROWS, environments=columns)
    buffer.add(
        replace(
            rollout,
            frames={"observation": np.stack([frames[ROWS * each :][: ROWS + 1] for each in range(columns)], 1)},
            actions={"action": actions.reshape(columns, ROWS).T[..., None]},
            initial_state=np.zeros((columns, 0), np.float32),
            terminated=np.zeros((ROWS, columns), np.bool_),
            truncated=np.zeros((ROWS, columns), np.bool_),
            valid=valid.reshape(columns, ROWS).T,
        )
    )
    return buffer


def test_a_policy_with_memory_imitates_what_was_shown_long_before() -> None:
    spec = TrainingSpec.model_validate({"algorithm": "appo", "learning_rate": 0.03, "cloning_updates": 40})
    learner = Learner(spec, MEMORY, CUE)
    learner.learn_from(cues([70] * 12))
    words = learner.clone().split()
    assert float(words[-4]) == pytest.approx(-np.log(2.0), abs=0.05)
    assert float(words[-2]) > -0.1  # of the last episode, which shows one cue


def test_the_state_is_carried_through_an_episode_from_its_beginning() -> None:
    torch.manual_seed(0)
    network, buffer = ActorCritic(MEMORY, CUE), cues([150])
    with torch.no_grad():
        network.policy_head.weight.normal_()
    learned = FlatParameters(network.learned_parameters())
    cloning = Cloning(network, learned, Forward(network, learned, has_target=False, is_mixed=False), CUE, buffer)
    shown = buffer.transitions(np.arange(150), 1, 1.0)
    states, log_probs = [torch.zeros((1, 8))], []
    for step in range(150):  # one row after the other
        # As the gradient does not go beyond the 64 rows of a minibatch, or beyond a new beginning:
        state = states[-1].detach() if step in (64, 128) else states[-1]
        observed = {name: values[step : step + 1] for name, values in shown.observations.items()}
        parameters, state = network.step(observed, state)
        states.append(state)
        actions = {"action": shown.actions[step : step + 1].long()}
        log_probs.append(network.distribution.log_prob(parameters, actions, {}))
    first, second = (torch.cat(log_probs[part]) for part in (slice(0, 64), slice(64, 128)))
    third = torch.cat([*log_probs[128:135], *log_probs[:57]])  # 15 of 150 are held out
    for expected in (first, second, third):
        found = cloning.gradient()
        wanted = torch.autograd.grad(
            -expected.mean(), network.learned_parameters(), materialize_grads=True, retain_graph=True
        )
        torch.testing.assert_close(found, torch.cat([each.flatten() for each in wanted]), atol=1e-6, rtol=1e-4)
    assert cloning.held_out() == pytest.approx(float(torch.cat(log_probs[135:]).detach().mean()), rel=1e-4)
