"""One seed for each evaluated episode: the results do not depend on how many environments play at once."""

from contextlib import closing
from typing import Any

import gymnasium
import numpy as np
import pytest
import torch
from allowed_modules import TEST_MODULES
from counting_environment import Counting
from plain import PlainPolicy

from daedalus.actor.environments.make import make_environments
from daedalus.actor.environments.vector_environments import VectorEnvironment
from daedalus.actor.evaluation.episodes import Evaluation, play_episodes
from daedalus.policy.acting.noise import Noise
from daedalus.policy.acting.program import export_program
from daedalus.policy.acting.runtime import OnnxRuntime
from daedalus.policy.network.actor_critic import ActorCritic
from daedalus.protocol.spaces import Spaces
from daedalus.protocol.spec import EnvironmentSpec, PolicySpec

EPISODES = 10
STEERING = ((-0.3, 0.3, 0.0), (0.3, 0.3, 0.0), (0.0, 0.0, 0.5))


def runtime(spaces: Spaces, **policy: Any) -> OnnxRuntime:
    """A random policy that depends on every observation."""
    torch.manual_seed(4)
    network = ActorCritic(PolicySpec.model_validate(policy), spaces)
    with torch.no_grad():
        network.policy_head.weight.mul_(100.0)  # a new head is nearly uniform
    loaded = OnnxRuntime(export_program(network, spaces))
    loaded.load({name: parameter.detach().numpy() for name, parameter in network.named_parameters()})
    return loaded


def played(
    spec: EnvironmentSpec, count: int, *, sampled: bool = True, episodes: int = EPISODES, seed: int = 1, **policy: Any
) -> Evaluation:
    with closing(make_environments(spec, count, modules=TEST_MODULES, one_episode=True)) as environments:
        return play_episodes(runtime(environments.spaces, **policy), environments, episodes, seed, sampled=sampled)


def assert_same(evaluations: list[Evaluation], differing: int) -> None:
    """Assert that the evaluations are equal, and that their episodes have at least `differing` results."""
    for one in evaluations[1:]:
        assert one.returns.tolist() == evaluations[0].returns.tolist()
        assert one.lengths.tolist() == evaluations[0].lengths.tolist()
    assert len(set(evaluations[0].returns.tolist())) >= differing


@pytest.mark.parametrize("memory", ["none", "gru"])
@pytest.mark.parametrize("sampled", [False, True])
def test_returns_do_not_depend_on_the_number_of_environments(sampled: bool, memory: str) -> None:
    spec = EnvironmentSpec(id="CartPole-v1", frame_stack=2)  # CartPole has a vector entry point of its own
    assert_same([played(spec, count, sampled=sampled, memory=memory) for count in (1, 3, 8)], differing=2)


def test_environments_in_processes_return_the_same() -> None:
    spec = EnvironmentSpec(id="CartPole-v1")
    in_processes = spec.model_copy(update={"processes": True})
    assert_same([played(spec, 1), played(in_processes, 2)], differing=4)


@pytest.mark.parametrize("backend", ["fast", "gymnasium"])
def test_car_racing_returns_the_same(backend: str) -> None:
    spec = EnvironmentSpec.model_validate(
        {"id": "CarRacing-v3", "backend": backend, "action_table": STEERING, "action_repeat": 4, "grey": True}
        | {"resize": (42, 42), "max_episode_steps": 40}
    )
    assert_same([played(spec, count, episodes=4, encoder="small") for count in (1, 3)], differing=3)


def test_envpool_returns_the_same() -> None:
    pytest.importorskip("envpool")
    cartpole = EnvironmentSpec(id="CartPole-v1", backend="envpool")
    assert_same([played(cartpole, count) for count in (1, 3, 8)], differing=4)
    pong = EnvironmentSpec(
        id="Pong-v5", backend="envpool", grey=True, action_repeat=4, resize=(42, 42), max_episode_steps=250
    )
    assert_same([played(pong, count, episodes=3, encoder="small") for count in (1, 3)], differing=2)


def test_ale_returns_the_same() -> None:
    pytest.importorskip("ale_py")
    spec = EnvironmentSpec(
        id="Breakout", backend="ale", grey=True, action_repeat=4, resize=(42, 42), max_episode_steps=400
    )
    assert_same([played(spec, count, episodes=4, encoder="small") for count in (1, 3)], differing=2)


def test_environment_with_a_vector_entry_point_only_plays_one_episode_at_a_time() -> None:
    gymnasium.register("VectorCartPole-v0", vector_entry_point=gymnasium.spec("CartPole-v1").vector_entry_point)
    try:
        spec = EnvironmentSpec(id="VectorCartPole-v0")
        environments = make_environments(spec, 8, one_episode=True)
        assert environments.count == 1
        environments.close()
        assert_same([played(spec, count) for count in (1, 8)], differing=4)
    finally:
        del gymnasium.registry["VectorCartPole-v0"]


def test_other_seeds_play_other_episodes() -> None:
    spec = EnvironmentSpec(id="CartPole-v1")
    assert played(spec, 3, seed=1).returns.tolist() != played(spec, 3, seed=2).returns.tolist()


def test_actions_are_sampled_with_other_numbers_in_each_episode() -> None:
    """With equal environments only the sampled actions tell episodes apart; Counting rewards a tenth of an action."""
    spec = EnvironmentSpec(id="counting_environment:Counting-v0", kwargs={"ends": [5]})
    assert len(set(played(spec, 8, episodes=8).returns.tolist())) >= 4


class Steps(Counting):
    """Counting that counts how often it is stepped and reset."""

    steps = resets = 0

    def __init__(self, **arguments: Any) -> None:
        super().__init__(**arguments)

    def reset(self, **arguments: Any) -> tuple[np.ndarray, dict]:
        Steps.resets += 1
        return super().reset(**arguments)

    def step(self, action: np.int64) -> tuple[np.ndarray, float, bool, bool, dict]:
        Steps.steps += 1
        return super().step(action)


def test_environment_stands_still_after_its_episode() -> None:
    """A step may be slow: only steps that count are made."""
    gymnasium.register("Steps-v0", Steps)
    try:
        environments: VectorEnvironment = make_environments(
            EnvironmentSpec(id="Steps-v0", kwargs={"ends": [2, 7]}), 3, one_episode=True
        )
        Steps.steps = Steps.resets = 0
        evaluation = play_episodes(runtime(environments.spaces), environments, 4, 1, sampled=False)
        assert evaluation.lengths.tolist() == [2, 2, 2, 7]
        # In the second round two environments play an episode that nobody asked for, as long as the first plays.
        assert Steps.resets == 6
        assert Steps.steps == 3 * 2 + 3 * 7
    finally:
        del gymnasium.registry["Steps-v0"]


class SmallestBatch(PlainPolicy):
    """A policy that remembers its smallest batch."""

    state_size = 1
    rows = 1000

    def choose(
        self, observations: np.ndarray, state: np.ndarray, noise: Noise
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        self.rows = min(self.rows, len(observations), len(state))
        return super().choose(observations, state, noise)


def test_single_environment_is_computed_as_a_batch_of_two() -> None:
    """A batch of one row is rounded differently, which may change a greedy action."""
    environments = make_environments(EnvironmentSpec(id="CartPole-v1"), 1, one_episode=True)
    policy = SmallestBatch()
    play_episodes(policy, environments, 1, 1, sampled=True)
    assert policy.rows == 2
