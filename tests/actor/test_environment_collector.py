"""EnvironmentCollector: the place of every row in a rollout, checked with an environment that counts."""

import copy
import itertools
import signal
import sys
import warnings
from typing import Any
from unittest import mock

import gymnasium
import numpy as np
import pytest
from allowed_modules import TEST_MODULES
from collectors import collect, started_collector
from plain import PlainPolicy, plain, vector_spaces

from daedalus.actor.collecting import environment_collector
from daedalus.actor.collecting.environment_collector import EnvironmentCollector
from daedalus.actor.environments.environment_errors import EnvironmentSetupError
from daedalus.actor.environments.vector_environments import Observed, Step
from daedalus.policy.acting.noise import Noise
from daedalus.policy.user_modules import USER_STATE, UserModules
from daedalus.protocol.spec import CollectionSpec, EnvironmentSpec, RunSpec
from daedalus.protocol.uploads import Rollout

COUNTING = EnvironmentSpec(id="counting_environment:Counting-v0")


class Scripted(PlainPolicy):
    """A policy that chooses 0, 1, 2, ... in turn, the same in every environment.

    Its memory is two numbers: the rows that it remembers, and the sum of the steps that it observed in them.
    """

    state_size = 2

    def __init__(self, choices: int = 4) -> None:
        self._choices = choices
        self.remembered: list[np.ndarray] = []
        self.calls = 0
        self.seen: list[np.ndarray] = []

    def choose(
        self, observations: np.ndarray, state: np.ndarray, noise: Noise
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        self.seen.append(observations.copy())
        self.remembered.append(state.copy())
        actions = np.full(len(observations), self.calls % self._choices)
        self.calls += 1
        next_state = state + np.stack([np.ones(len(state)), observations[:, 1]], axis=1).astype(np.float32)
        return actions, np.full(len(observations), -0.5 * self.calls, np.float32), next_state


@pytest.fixture
def collected() -> tuple[list[Rollout], Scripted]:
    """Three rollouts of four rows, one environment, episodes of 3 (terminated), 2 (truncated), 1 (terminated)."""
    policy = Scripted()
    collector = started_collector(COUNTING, policy, rollout_length=4)
    return [copy.deepcopy(collect(collector)) for _ in range(3)], policy


# By hand: twelve rows of episodes 0 (three steps, terminated), 1 (two steps, truncated), 2 (one step,
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


def test_each_row_holds_its_observation_action_reward_and_flags(collected: tuple[list[Rollout], Scripted]) -> None:
    """Row 2 ends episode 0; row 3 still shows its last observation, which the value of row 2's successor needs."""
    rollouts, policy = collected
    observations = np.concatenate([plain(rollout.frames)[:-1, 0] for rollout in rollouts])
    np.testing.assert_array_equal(observations, np.stack([EPISODE, STEP], axis=1))
    np.testing.assert_array_equal(observations, np.concatenate(policy.seen))
    np.testing.assert_array_equal(np.concatenate([plain(rollout.actions)[:, 0, 0] for rollout in rollouts]), ACTION)
    np.testing.assert_allclose(rows(rollouts, "rewards"), REWARD, rtol=1e-6)
    np.testing.assert_allclose(rows(rollouts, "behaviour_log_probs"), -0.5 * np.arange(1, 13))
    for name, expected in (("terminated", TERMINATED), ("truncated", TRUNCATED), ("valid", VALID)):
        np.testing.assert_array_equal(rows(rollouts, name), expected)
    for before, after in itertools.pairwise(rollouts):
        np.testing.assert_array_equal(plain(before.frames)[-1], plain(after.frames)[0])


def test_episode_returns_are_in_the_rollout_where_the_episode_ends(
    collected: tuple[list[Rollout], Scripted],
) -> None:
    """They are exact in float64, though the rewards that learning uses are float32: they may be the target return."""
    rollouts, _ = collected
    returns = [(REWARD * (EPISODE == episode)).sum() for episode in range(4)]
    np.testing.assert_allclose(rollouts[0].episode_returns, [returns[0]], rtol=1e-12)
    np.testing.assert_allclose(rollouts[1].episode_returns, [returns[1], returns[2]], rtol=1e-12)
    np.testing.assert_allclose(rollouts[2].episode_returns, [returns[3]], rtol=1e-12)
    assert [rollout.episode_lengths.tolist() for rollout in rollouts] == [[3], [2, 1], [3]]


def test_rewards_are_scaled_and_episode_returns_are_not() -> None:
    spec = COUNTING.model_copy(update={"reward_scale": 0.5})
    collector = started_collector(spec, Scripted(), count=2, rollout_length=3)
    rollout = collect(collector)
    np.testing.assert_allclose(rollout.rewards[:, 0], 0.5 * REWARD[:3], rtol=1e-6)
    np.testing.assert_allclose(rollout.episode_returns, [REWARD[:3].sum()] * 2, rtol=1e-6)
    second = collect(collector)  # scaling must not change what is carried over
    np.testing.assert_allclose(second.rewards[:, 1], 0.5 * REWARD[3:6], rtol=1e-6)


def test_rewards_are_clipped_before_scaling_and_episode_returns_are_not() -> None:
    spec = COUNTING.model_copy(update={"reward_clip": 10.5, "reward_scale": 0.5})
    collector = started_collector(spec, Scripted(), rollout_length=4)
    rollouts = [copy.deepcopy(collect(collector)) for _ in range(3)]
    assert (REWARD > 10.5).any()
    assert ((REWARD > 5.25) & (REWARD < 10.5)).any()  # these would be clipped if scaling came first
    np.testing.assert_allclose(rows(rollouts, "rewards"), 0.5 * np.minimum(REWARD, 10.5), rtol=1e-6)
    returns = np.concatenate([rollout.episode_returns for rollout in rollouts])
    np.testing.assert_allclose(returns, [(REWARD * (EPISODE == episode)).sum() for episode in range(4)], rtol=1e-6)


def test_bootstrap_terminations_turns_terminations_into_truncations() -> None:
    def collect_three(spec: EnvironmentSpec) -> list[Rollout]:
        collector = started_collector(spec, Scripted(), rollout_length=4)
        return [copy.deepcopy(collect(collector)) for _ in range(3)]

    episodic = collect_three(COUNTING)
    bootstrapped = collect_three(COUNTING.model_copy(update={"bootstrap_terminations": True}))
    terminated, truncated = rows(episodic, "terminated"), rows(episodic, "truncated")
    assert terminated.any()
    assert truncated.any()
    assert not rows(bootstrapped, "terminated").any()
    np.testing.assert_array_equal(rows(bootstrapped, "truncated"), terminated | truncated)
    for name in ("valid", "rewards", "episode_returns", "episode_lengths"):
        for ours, theirs in zip(bootstrapped, episodic, strict=True):
            np.testing.assert_array_equal(getattr(ours, name), getattr(theirs, name))


class _Losing(gymnasium.Env[np.ndarray, np.int64]):
    """Every step costs 3."""

    observation_space = gymnasium.spaces.Box(0, 1, (2,), np.float32)
    action_space = gymnasium.spaces.Discrete(4)

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[np.ndarray, dict]:
        return np.zeros(2, np.float32), {}

    def step(self, action: np.int64) -> tuple[np.ndarray, float, bool, bool, dict]:
        return np.zeros(2, np.float32), -3.0, False, False, {}


class _Ending(_Losing):
    """Terminates at its third step."""

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[np.ndarray, dict]:
        self.steps = 0
        return super().reset()

    def step(self, action: np.int64) -> tuple[np.ndarray, float, bool, bool, dict]:
        self.steps += 1
        return np.zeros(2, np.float32), -3.0, self.steps == 3, False, {}


gymnasium.register("Losing-v0", lambda **_kwargs: _Losing())
gymnasium.register("Ending-v0", lambda **_kwargs: _Ending())


@pytest.mark.parametrize("bootstrap", [False, True])
def test_value_after_an_episode_that_no_reward_limit_ends_is_zero(bootstrap: bool) -> None:
    """Bootstrapped, the value of a car that is lost would be learnt from itself."""
    spec = EnvironmentSpec(id="Losing-v0", no_reward_limit=3, bootstrap_terminations=bootstrap)
    rollout = collect(started_collector(spec, Scripted(), rollout_length=8))
    ends = [False, False, True, False, False, False, True, False]  # the row after an end resets
    assert rollout.terminated.T.tolist() == [ends] * rollout.environments
    assert (rollout.truncated >= rollout.terminated).all()


@pytest.mark.parametrize("no_reward_limit", [None, 5], ids=["unlimited", "limited"])
def test_termination_at_the_time_limit_is_bootstrapped_like_any_other(no_reward_limit: int | None) -> None:
    """gymnasium's time limit sets both flags there, but nobody gave the episode up."""
    spec = EnvironmentSpec(
        id="Ending-v0", max_episode_steps=3, bootstrap_terminations=True, no_reward_limit=no_reward_limit
    )
    rollout = collect(started_collector(spec, Scripted(), rollout_length=4))
    assert not rollout.terminated.any()
    assert rollout.truncated[:, 0].tolist() == [False, False, True, False]


def test_negative_rewards_are_clipped_like_positive_ones() -> None:
    spec = EnvironmentSpec(id="Losing-v0", max_episode_steps=2, reward_clip=1.0, reward_scale=2.0)
    rollout = collect(started_collector(spec, Scripted(), rollout_length=2))
    assert rollout.rewards[:, 0].tolist() == [-2.0, -2.0]
    assert rollout.episode_returns.tolist() == [-6.0]


# The memory before each of the twelve rows: the earlier rows of the episode, and the sum of their steps. The reset row
# of an episode is its last; the memory that follows it is discarded.
REMEMBERED = np.array([[0, 0], [1, 0], [2, 1], [3, 3], [0, 0], [1, 0], [2, 1], [0, 0], [1, 0], [0, 0], [1, 0], [2, 1]])


def test_memory_covers_the_running_episode_only_and_a_rollout_holds_that_before_its_first_row(
    collected: tuple[list[Rollout], Scripted],
) -> None:
    rollouts, policy = collected
    np.testing.assert_array_equal(np.concatenate(policy.remembered), REMEMBERED)
    begins = np.concatenate([rollout.initial_state for rollout in rollouts])
    np.testing.assert_array_equal(begins, REMEMBERED[[0, 4, 8]])
    assert begins[2].any()  # it begins in the middle of an episode


def test_each_environment_has_its_own_memory() -> None:
    """Their episodes end at different steps: each memory is reset at the starts of its own episodes."""
    spec = EnvironmentSpec(id="CartPole-v1")
    policy = Scripted(choices=1)
    rollout = collect(started_collector(spec, policy, count=3, rollout_length=40, seed=3))
    starts = np.concatenate([np.zeros((1, 3), bool), ~rollout.valid[:-1]])
    assert (starts.any(axis=1) != starts.all(axis=1)).any()
    expected = np.zeros(3)
    for row in range(40):
        expected = np.where(starts[row], 0, expected)
        np.testing.assert_array_equal(policy.remembered[row][:, 0], expected)
        expected += 1


def test_rollout_of_a_policy_without_memory_has_an_empty_state() -> None:
    rollout = collect(started_collector(COUNTING, Memoryless(), count=3, rollout_length=4))
    assert rollout.initial_state.shape == (3, 0)


class Memoryless(Scripted):
    state_size = 0

    def choose(
        self, observations: np.ndarray, state: np.ndarray, noise: Noise
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        assert state.shape == (len(observations), 0)
        return np.zeros(len(observations), np.int64), np.zeros(len(observations), np.float32), state


STACKED = COUNTING.model_copy(update={"frame_stack": 3})


def test_each_frame_is_in_a_rollout_once_after_the_stack_of_the_first_row() -> None:
    collector = started_collector(STACKED, Memoryless(), rollout_length=4)
    rollouts = [copy.deepcopy(collect(collector)) for _ in range(3)]
    shown = [frame.tolist() for frame in np.stack([EPISODE, STEP], axis=1)]
    assert plain(rollouts[0].frames)[:, 0].tolist() == [shown[0]] * 2 + shown[:5]
    # Row 4 is the first of episode 1: its stack has no frame of episode 0.
    assert plain(rollouts[1].frames)[:, 0].tolist() == [shown[4]] * 2 + shown[4:9]
    # Row 8 is the reset row of episode 2, which was two frames long.
    assert plain(rollouts[2].frames)[:, 0].tolist() == [shown[7], shown[7], *shown[8:], [3, 3]]


def test_cartpole_vector_entry_point_resets_after_truncations_too() -> None:
    """An implementation that resets on termination only never ends a truncated episode."""
    spec = EnvironmentSpec(id="CartPole-v1", max_episode_steps=5)
    rollout = collect(started_collector(spec, Scripted(choices=2), count=3, rollout_length=12, seed=3))
    assert rollout.truncated[[4, 10]].all()
    assert not rollout.terminated.any()
    assert not rollout.valid[[5, 11]].any()
    assert rollout.valid.sum() == 3 * 10
    assert (np.abs(plain(rollout.frames)[6]) <= 0.05).all()  # the start of an episode
    assert (np.abs(plain(rollout.frames)[5]) > 0.05).any()  # the true last observation
    np.testing.assert_array_equal(rollout.episode_lengths, [5] * 6)


class Seeds(PlainPolicy):
    """Environments that keep the seed of their reset, and a policy that keeps its noise."""

    count, seats, games = 1, 1, None
    spaces = vector_spaces(2, 4)

    def __init__(self) -> None:
        self.seed = -1
        self.noise: Noise | None = None
        self.closed = False

    def reset(self, seed: int) -> Observed:
        self.seed = seed
        return self._observed()

    def step(self, actions: dict[str, np.ndarray]) -> Step:
        return self._observed(), np.zeros(1), np.zeros(1, np.bool_), np.zeros(1, np.bool_)

    def set_parameters(self, parameters: Any) -> None:
        raise AssertionError("the run has no parameters")

    def take_episode_info(self) -> dict[str, np.ndarray]:
        return {}

    def close(self) -> None:
        self.closed = True

    def choose(
        self, observations: np.ndarray, state: np.ndarray, noise: Noise
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        self.noise = self.noise or noise
        return super().choose(observations, state, noise)

    @staticmethod
    def _observed() -> Observed:
        return Observed({"observation": np.zeros((1, 2), np.float32)}, {})


def drawn(seed: int) -> tuple[list[float], list[float]]:
    """Return the first random numbers of the environment and of the policy."""
    both = Seeds()
    collect(started_collector(COUNTING, both, rollout_length=1, seed=seed, environments=both))
    assert both.noise is not None
    return np.random.default_rng(both.seed).random(2, np.float32).tolist(), both.noise.uniform[0].tolist()


def test_environments_and_actions_draw_from_different_random_numbers_which_a_seed_determines() -> None:
    """With one seed for both, the numbers that choose the actions would be those of the environment."""
    assert len({tuple(numbers) for seed in (1, 2) for numbers in drawn(seed)}) == 4
    assert drawn(1) == drawn(1)


def test_environments_are_made_anew_for_another_specification_only() -> None:
    made: list[Seeds] = []

    def make(*_arguments: object, **_named: object) -> Seeds:
        made.append(Seeds())
        return made[-1]

    run = RunSpec(environment=COUNTING)
    collector = EnvironmentCollector()
    with mock.patch.object(environment_collector, "make_environments", make):
        assert collector.prepare(run.for_actors()) == (Seeds.spaces, 1)
        collector.prepare(run.model_copy(update={"collection": CollectionSpec(rollout_length=7)}).for_actors())
        assert [each.closed for each in made] == [False]
        collector.prepare(RunSpec(environment=STACKED).for_actors())
        assert [each.closed for each in made] == [True, False]
        collector.prepare(RunSpec(environment=STACKED).for_actors())
        assert [each.closed for each in made] == [True, False]
    collector.close()
    assert [each.closed for each in made] == [True, True]


@pytest.mark.parametrize("own_count", [None, 3])
def test_environments_are_made_anew_for_another_number_of_them(own_count: int | None) -> None:
    """A run may be resumed with another collection.envs_per_actor; a number of the actor's own stays."""
    collector = EnvironmentCollector(own_count, TEST_MODULES)
    counts = []
    for count in (2, 4, 4):
        run = RunSpec(environment=COUNTING, collection=CollectionSpec(envs_per_actor=count))
        counts.append(collector.prepare(run.for_actors())[1])
    collector.close()
    assert counts == ([2, 4, 4] if own_count is None else [3] * 3)


def test_environments_are_kept_if_the_backend_makes_fewer_than_requested() -> None:
    run = RunSpec(environment=COUNTING, collection=CollectionSpec(envs_per_actor=8))
    collector = EnvironmentCollector()
    with mock.patch.object(environment_collector, "make_environments", side_effect=lambda *_, **__: Seeds()) as make:
        assert [collector.prepare(run.for_actors())[1] for _ in range(2)] == [1, 1]
    assert make.call_count == 1


# --------------------------------------------------------------------------- observations that the learner refuses


class Summing(PlainPolicy):
    """A policy whose memory is the sum of all observations, for stacks, of their newest frame."""

    state_size = 1

    def choose(
        self, observations: np.ndarray, state: np.ndarray, noise: Noise
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        newest = observations.reshape(len(observations), -1)[:, -1:]
        return np.zeros(len(state), np.int64), np.zeros(len(state), np.float32), state + newest


def _unfit(rollout: Rollout) -> bool:
    return not all(np.isfinite(values).all() for values in (plain(rollout.frames), rollout.initial_state))


@pytest.mark.parametrize("number", ["nan", "inf", "-inf"])
@pytest.mark.parametrize("place", [2, 9, 10])  # within an episode, before its end, and its last one
@pytest.mark.parametrize(("rollout_length", "frame_stack"), [(3, 1), (1, 1), (4, 4)])
def test_one_number_that_is_not_finite_spoils_at_most_two_rollouts(
    number: str, place: int, rollout_length: int, frame_stack: int
) -> None:
    """Three in a row quarantine an actor. Episodes have 10 steps, only the first environment is at fault."""
    shown: list[Any] = [1.0] * 11
    shown[place] = number
    spec = EnvironmentSpec(id="showing_environments:Showing-v0", kwargs={"shown": shown}, frame_stack=frame_stack)
    modules = UserModules(frozenset({"showing_environments"}))
    collector = started_collector(spec, Summing(), count=2, rollout_length=rollout_length, modules=modules)
    rollouts = [copy.deepcopy(collect(collector)) for _ in range(16 // rollout_length)]
    spoilt = [_unfit(rollout) for rollout in rollouts]
    assert 1 <= sum(spoilt[: 12 // rollout_length]) <= 2
    collector.close()


# ------------------------------------------------------------------------------------- steps that only reset


def _showing_vector(oddity: str) -> EnvironmentSpec:
    return EnvironmentSpec(id="showing_environments:ShowingVector-v0", kwargs={"shown": [0, 0, 0], "oddity": oddity})


def test_rewards_of_a_step_that_only_resets_do_not_count(caplog: pytest.LogCaptureFixture) -> None:
    modules = UserModules(frozenset({"showing_environments"}))
    collector = started_collector(_showing_vector("rewards"), PlainPolicy(), rollout_length=9, modules=modules)
    rollout = collect(collector)
    assert rollout.rewards[:, 0].tolist() == [1, 1, 0] * 3
    assert rollout.valid[:, 0].tolist() == [True, True, False] * 3
    assert rollout.episode_returns.tolist() == [2.0] * 3
    assert caplog.text.count("it gives the reward 50 in a step that only resets") == 1


def test_an_episode_that_ends_in_a_step_that_only_resets_is_refused() -> None:
    modules = UserModules(frozenset({"showing_environments"}))
    collector = started_collector(_showing_vector("flags"), PlainPolicy(), rollout_length=9, modules=modules)
    with pytest.raises(EnvironmentSetupError, match="environment 0 ends an episode in the step after an episode's end"):
        collect(collector)


@pytest.mark.parametrize("processes", [False, True])
def test_state_of_the_interpreter_that_an_environment_sets_is_its_own(
    processes: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """1e-42 and 1e300 make a cast to float32 raise under `np.seterr(all="raise")`."""
    monkeypatch.setattr(USER_STATE, "_theirs", None)  # for the next tests, too
    before = np.geterr(), list(warnings.filters), sys.stdout, signal.getsignal(signal.SIGTERM)
    kwargs = {"shown": [0, 1e-42, 1e300, 1.0, 0], "space": "float64"}
    spec = EnvironmentSpec(id="showing_environments:Strict-v0", kwargs=kwargs, processes=processes)
    modules = UserModules(frozenset({"showing_environments"}))
    collector = started_collector(spec, PlainPolicy(), count=2, rollout_length=4, modules=modules)
    assert collect(collector).frames["observation"][:, 0, 0].tolist() == pytest.approx([0, 0, np.inf, 1.0, 0])
    collector.close()
    assert (np.geterr(), list(warnings.filters), sys.stdout, signal.getsignal(signal.SIGTERM)) == before
