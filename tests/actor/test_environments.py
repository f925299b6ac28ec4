"""What can be played, and what is said about what cannot."""

import gymnasium
import numpy as np
import pytest

from actor.environments import UnplayableError, make_environments
from protocol.spec import EnvironmentSpec


@pytest.mark.parametrize("name", ["CartPole-v1", "Acrobot-v1", "LunarLander-v3"])
def test_environments_follow_the_next_step_rule(name: str) -> None:
    """After an end: a row with reward 0 that shows the first observation next; the same for every way of stepping."""
    environments = make_environments(EnvironmentSpec(id=name, max_episode_steps=4), 2)
    observations = environments.reset(5)
    assert observations.shape == (2, *environments.spaces.observation.shape)
    for step in range(1, 11):
        _, rewards, terminated, truncated = environments.step(np.zeros(2, np.int64))
        if step in (5, 10):
            np.testing.assert_array_equal(rewards, 0.0)
        assert (terminated | truncated).all() == (step in (4, 9))
    environments.close()


def test_an_unknown_environment_is_named_with_near_matches() -> None:
    with pytest.raises(UnplayableError, match="unknown environment 'CartPoll-v1': did you mean CartPole-v1"):
        make_environments(EnvironmentSpec(id="CartPoll-v1"), 1)


def test_a_module_that_is_not_there_is_named() -> None:
    with pytest.raises(UnplayableError, match="cannot import no_such_module"):
        make_environments(EnvironmentSpec(id="no_such_module:Mine-v0"), 1)


def test_spaces_that_do_not_travel_are_named() -> None:
    with pytest.raises(UnplayableError, match=r"action space Box.*must be Discrete"):
        make_environments(EnvironmentSpec(id="Pendulum-v1"), 1)


def test_a_keyword_that_the_environment_does_not_take_is_told() -> None:
    with pytest.raises(UnplayableError, match=r"cannot be made.*no_such_option"):
        make_environments(EnvironmentSpec(id="Acrobot-v1", kwargs={"no_such_option": 1}), 1)


class _StartsAtFive(gymnasium.Env):
    """Takes the actions 5 and 6, and nothing else."""

    observation_space = gymnasium.spaces.Box(0, 1, (1,), np.float32)
    action_space = gymnasium.spaces.Discrete(2, start=5)

    def reset(self, *, seed=None, options=None):
        return np.zeros(1, np.float32), {}

    def step(self, action):
        assert action in (5, 6)
        return np.zeros(1, np.float32), float(action), False, False, {}


def test_choices_are_numbered_from_zero_whatever_the_environments_start() -> None:
    gymnasium.register("StartsAtFive-v0", lambda **_kwargs: _StartsAtFive())
    environments = make_environments(EnvironmentSpec(id="StartsAtFive-v0"), 2)
    environments.reset(1)
    assert environments.spaces.action.count == 2
    np.testing.assert_array_equal(environments.step(np.array([0, 1]))[1], [5.0, 6.0])
