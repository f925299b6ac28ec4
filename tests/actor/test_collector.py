"""Every row of a rollout in its place, shown by an environment that counts."""

import copy
import itertools

import numpy as np
import pytest

from actor.collector import Collector
from actor.environments import make_environments
from protocol.messages import Rollout, RolloutIdentity
from protocol.spec import EnvironmentSpec

IDENTITY = RolloutIdentity(actor="a", incarnation=1, sequence=0, learner_epoch=1)


class Scripted:
    """A policy that plays 0, 1, 2, ... and over again, the same in every environment."""

    def __init__(self, choices: int = 4) -> None:
        self._choices = choices
        self.calls = 0
        self.seen: list[np.ndarray] = []

    def load(self, weights: dict[str, np.ndarray]) -> None:
        pass

    def act(self, observations: np.ndarray, random: np.random.Generator | None) -> tuple[np.ndarray, np.ndarray]:
        self.seen.append(observations.copy())
        actions = np.full(len(observations), self.calls % self._choices)
        self.calls += 1
        return actions, np.full(len(observations), -0.5 * self.calls, np.float32)


@pytest.fixture
def collected() -> tuple[list[Rollout], Scripted]:
    """Three rollouts of four rows, one environment, episodes of 3 (terminated), 2 (truncated), 1 (terminated)."""
    environments = make_environments(EnvironmentSpec(id="counting_environment:Counting-v0"), 1)
    policy = Scripted()
    collector = Collector(environments, policy, rollout_length=4, reward_scale=1.0, seed=1)
    return [copy.deepcopy(collector.collect(IDENTITY, 7)) for _ in range(3)], policy


# Written out by hand: twelve rows of episodes 0 (three steps, terminated), 1 (two steps, truncated), 2 (one step,
# terminated), 3 (three steps). X marks the reset rows: row 3 after episode 0, row 6 after episode 1, row 8 after 2.
#          row:           0    1    2    3X   4    5    6X   7    8X   9   10   11
EPISODE = np.array([0, 0, 0, 0, 1, 1, 1, 2, 2, 3, 3, 3])
STEP = np.array([0, 1, 2, 3, 0, 1, 2, 0, 1, 0, 1, 2])
VALID = np.array([1, 1, 1, 0, 1, 1, 0, 1, 0, 1, 1, 1], bool)
TERMINATED = np.array([0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 1], bool)
TRUNCATED = np.array([0, 0, 0, 0, 0, 1, 0, 0, 0, 0, 0, 0], bool)
ACTION = np.arange(12) % 4
REWARD = np.where(VALID, 10 * EPISODE + STEP + ACTION / 10, 0)


def rows(rollouts: list[Rollout], name: str) -> np.ndarray:
    return np.concatenate([getattr(rollout, name)[:, 0] for rollout in rollouts])


def test_each_row_holds_its_observation_action_and_reward(collected: tuple[list[Rollout], Scripted]) -> None:
    rollouts, policy = collected
    observations = np.concatenate([rollout.observations[:-1, 0] for rollout in rollouts])
    np.testing.assert_array_equal(observations, np.stack([EPISODE, STEP], axis=1))
    np.testing.assert_array_equal(observations, np.concatenate(policy.seen))
    np.testing.assert_array_equal(rows(rollouts, "actions"), ACTION)
    np.testing.assert_allclose(rows(rollouts, "rewards"), REWARD, rtol=1e-6)
    np.testing.assert_allclose(rows(rollouts, "behaviour_log_probs"), -0.5 * np.arange(1, 13))


def test_termination_truncation_and_reset_rows_are_told_apart(collected: tuple[list[Rollout], Scripted]) -> None:
    rollouts, _ = collected
    np.testing.assert_array_equal(rows(rollouts, "terminated"), TERMINATED)
    np.testing.assert_array_equal(rows(rollouts, "truncated"), TRUNCATED)
    np.testing.assert_array_equal(rows(rollouts, "valid"), VALID)


def test_the_row_after_an_end_shows_the_true_last_observation(collected: tuple[list[Rollout], Scripted]) -> None:
    rollouts, _ = collected
    # Row 2 ends episode 0; row 3 still shows its observation 3, which the value of row 2's successor needs.
    np.testing.assert_array_equal(rollouts[0].observations[3, 0], [0, 3])
    np.testing.assert_array_equal(rollouts[1].observations[2, 0], [1, 2])


def test_the_last_observation_of_a_rollout_is_the_first_of_the_next(collected: tuple[list[Rollout], Scripted]) -> None:
    rollouts, _ = collected
    for before, after in itertools.pairwise(rollouts):
        np.testing.assert_array_equal(before.observations[-1], after.observations[0])


def test_episodes_are_reported_where_they_end_with_their_true_returns(
    collected: tuple[list[Rollout], Scripted],
) -> None:
    rollouts, _ = collected
    returns = [(REWARD * (EPISODE == episode)).sum() for episode in range(4)]
    np.testing.assert_allclose(rollouts[0].episode_returns, [returns[0]], rtol=1e-6)
    np.testing.assert_allclose(rollouts[1].episode_returns, [returns[1], returns[2]], rtol=1e-6)
    np.testing.assert_allclose(rollouts[2].episode_returns, [returns[3]], rtol=1e-6)
    assert [rollout.episode_lengths.tolist() for rollout in rollouts] == [[3], [2, 1], [3]]


def test_rewards_are_scaled_for_learning_and_not_in_returns() -> None:
    environments = make_environments(EnvironmentSpec(id="counting_environment:Counting-v0"), 2)
    collector = Collector(environments, Scripted(), rollout_length=3, reward_scale=0.5, seed=1)
    rollout = collector.collect(IDENTITY, 0)
    np.testing.assert_allclose(rollout.rewards[:, 0], 0.5 * REWARD[:3], rtol=1e-6)
    np.testing.assert_allclose(rollout.episode_returns, [REWARD[:3].sum()] * 2, rtol=1e-6)
    second = collector.collect(IDENTITY, 0)  # scaling must not reach into what is carried over
    np.testing.assert_allclose(second.rewards[:, 1], 0.5 * REWARD[3:6], rtol=1e-6)


def test_cartpoles_own_vector_entry_point_resets_on_truncation_too() -> None:
    """The notes' notebook resets on termination only; an episode cut by its limit then never ends."""
    environments = make_environments(EnvironmentSpec(id="CartPole-v1", max_episode_steps=5), 3)
    collector = Collector(environments, Scripted(choices=2), rollout_length=12, reward_scale=1.0, seed=3)
    rollout = collector.collect(IDENTITY, 0)
    assert rollout.truncated[[4, 10]].all()
    assert not rollout.terminated.any()
    assert not rollout.valid[[5, 11]].any()
    assert rollout.valid.sum() == 3 * 10
    assert (np.abs(rollout.observations[6]) <= 0.05).all()  # a fresh start
    assert (np.abs(rollout.observations[5]) > 0.05).any()  # the true last one
    np.testing.assert_array_equal(rollout.episode_lengths, [5] * 6)
