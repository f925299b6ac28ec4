"""make_environments: what it creates, and its errors."""

import re
import warnings
from pathlib import Path
from typing import Any, Literal

import gymnasium
import numpy as np
import pytest
from allowed_modules import TEST_MODULES
from plain import PlainEnvironments, choices

from daedalus.actor.environments.environment_errors import EnvironmentSetupError
from daedalus.actor.environments.make import make_bare, make_environments
from daedalus.actor.environments.transforms import Transforms
from daedalus.actor.environments.vector_environments import BackendEnvironments
from daedalus.policy.user_modules import UserModules
from daedalus.protocol.spaces import ContinuousSpace, DiscreteSpace
from daedalus.protocol.spec import EnvironmentSpec


@pytest.mark.parametrize(
    ("name", "backend"),
    [
        ("CartPole-v1", "gymnasium"),
        ("Acrobot-v1", "gymnasium"),
        ("LunarLander-v3", "gymnasium"),
        ("CartPole-v1", "envpool"),
        ("Acrobot-v1", "envpool"),
        ("Pong-v5", "envpool"),
        ("Pong-v5", "ale"),
    ],
)
def test_environments_follow_the_next_step_rule(name: str, backend: Literal["gymnasium", "envpool", "ale"]) -> None:
    """After an episode's end a step has reward 0 and observes the first frame, with every backend."""
    _needs(backend)
    environments = PlainEnvironments(
        make_environments(EnvironmentSpec(id=name, backend=backend, max_episode_steps=4), 2)
    )
    observations = environments.reset(5)
    assert observations.shape == (2, *environments.spaces.observations["observation"].shape)
    for step in range(1, 11):
        _, rewards, terminated, truncated = environments.step(np.full(2, step % 2))
        if step in (5, 10):
            np.testing.assert_array_equal(rewards, 0.0)
        assert (terminated | truncated).all() == (step in (4, 9))
    environments.close()


@pytest.mark.parametrize("backend", ["gymnasium", "envpool"])
def test_reset_step_ignores_its_action(backend: Literal["gymnasium", "envpool"]) -> None:
    _needs(backend)
    starts = []
    for action in (0, 1):
        environments = PlainEnvironments(
            make_environments(EnvironmentSpec(id="CartPole-v1", backend=backend, max_episode_steps=3), 2)
        )
        environments.reset(5)
        for _ in range(3):
            environments.step(np.zeros(2, np.int64))
        starts.append(environments.step(np.full(2, action))[0])
        environments.close()
    np.testing.assert_array_equal(*starts)
    assert (np.abs(starts[0]) <= 0.05).all(), "CartPole starts within 0.05 of zero"


def _needs(backend: str) -> None:
    if backend != "gymnasium":
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)  # envpool warns about its own spaces
            pytest.importorskip({"envpool": "envpool", "ale": "ale_py.vector_env"}[backend])


def test_unknown_environment_error_suggests_close_matches() -> None:
    with pytest.raises(EnvironmentSetupError, match="unknown environment 'CartPoll-v1': did you mean CartPole-v1"):
        make_environments(EnvironmentSpec(id="CartPoll-v1"), 1)


@pytest.mark.parametrize(
    ("name", "hint"),
    [
        ("cartpole", "did you mean CartPole-v1 or CartPole-v0? Or, if it is your own, write module:cartpole, with the"),
        ("Zebrafish-v0", "if it is your own, write module:Zebrafish-v0, with the module that registers it"),
    ],
)
def test_unknown_environment_may_be_the_users_own(name: str, hint: str) -> None:
    with pytest.raises(EnvironmentSetupError) as error:
        make_environments(EnvironmentSpec(id=name), 1)
    assert str(error.value).startswith(f"unknown environment {name!r}: {hint}")


@pytest.mark.parametrize(
    ("name", "hint"),
    [
        ("faulty_environments:Fault-v0", "; did you mean faulty_environments:Faulty-v0?"),
        ("faulty_environments:Corridor-v1", "; it registers faulty_environments:Faulty-v0"),
        ("colorsys:Corridor-v1", ""),
    ],
)
def test_environment_that_its_module_does_not_register_is_reported_with_the_file(name: str, hint: str) -> None:
    module, _, asked = name.partition(":")
    with pytest.raises(EnvironmentSetupError) as error:
        make_environments(EnvironmentSpec(id=name), 1, modules=UserModules(frozenset({module})))
    assert re.fullmatch(
        rf"unknown environment '{name}': \S*{module}.py registers no {asked}, and .*{re.escape(hint)}",
        str(error.value),
    )


def test_missing_module_is_named() -> None:
    with pytest.raises(EnvironmentSetupError, match="cannot import no_such_module"):
        make_environments(
            EnvironmentSpec(id="no_such_module:Mine-v0"), 1, modules=UserModules(frozenset({"no_such_module"}))
        )


def test_continuous_actions_are_scaled_from_their_bounds() -> None:
    """Pendulum's torque lies between -2 and 2, and its reward decreases by 0.001 of the squared torque."""
    rewards = []
    for action in (0.0, 0.5, 1.0, 7.0):  # the last lies beyond the bounds
        environments = make_environments(EnvironmentSpec(id="Pendulum-v1"), 1)
        assert environments.spaces.actions == {"action": ContinuousSpace(low=(-2.0,), high=(2.0,))}
        environments.reset(1)
        rewards.append(float(environments.step({"action": np.array([[action]], np.float32)})[1][0]))
    assert (rewards[0] - np.array(rewards)).tolist() == pytest.approx([0.0, 0.001, 0.004, 0.004])


@pytest.mark.parametrize(
    ("table", "reason"),
    [
        (((1.0,), (0.5, 0.5)), r"row 1 has 2 numbers, but an action of space Box\(-2.0, 2.0, \(1,\), float32\) has 1"),
        (((0.0,), (-2.0,), (2.5,)), r"row 2 is \(2.5,\), outside action space Box"),
    ],
)
def test_table_that_does_not_fit_is_reported_with_the_space(table: tuple, reason: str) -> None:
    with pytest.raises(EnvironmentSetupError, match=f"environment.action_table {reason}"):
        make_environments(EnvironmentSpec(id="Pendulum-v1", action_table=table), 1)


def test_table_over_a_discrete_space_is_refused() -> None:
    with pytest.raises(
        EnvironmentSetupError, match=r"action_table has 2 rows, but action space Discrete\(2\) needs no table"
    ):
        make_environments(EnvironmentSpec(id="CartPole-v1", action_table=((0.0,), (1.0,))), 1)


def test_table_rows_are_the_actions() -> None:
    """Pendulum's reward decreases by 0.001 of the squared torque."""
    rewards = []
    for table in (((0.0,), (0.0,)), ((0.0,), (2.0,))):
        environments = PlainEnvironments(make_environments(EnvironmentSpec(id="Pendulum-v1", action_table=table), 1))
        environments.reset(1)
        assert choices(environments.spaces) == 2
        rewards.append(float(environments.step(np.array([1]))[1][0]))
    assert rewards[0] - rewards[1] == pytest.approx(0.004)


PEDALS = {"action_table": ((0.0, 0.0), (1.0, 0.0), (0.0, 0.8)), "action_table_columns": (1, 2)}


def test_a_table_of_some_numbers_leaves_the_others_to_the_policy() -> None:
    space = gymnasium.spaces.Box(np.array([-1.0, 0.0, 0.0], np.float32), 1.0, (3,), np.float32)
    spec = EnvironmentSpec(id="CarRacing-v3", **PEDALS)
    transforms = Transforms(spec, gymnasium.spaces.Box(0, 255, (96, 96, 3), np.uint8), space)
    assert transforms.spaces.actions == {
        "continuous": ContinuousSpace(low=(-1.0,), high=(1.0,)),
        "table": DiscreteSpace(counts=(3,)),
    }
    chosen = {"continuous": np.array([[-0.5], [3.0]], np.float32), "table": np.array([[2], [1]])}
    assert transforms.env_actions(chosen) == pytest.approx(np.array([[-0.5, 0.0, 0.8], [1.0, 1.0, 0.0]]))
    assert transforms.env_action({name: values[:1] for name, values in chosen.items()}).shape == (3,)


def test_the_columns_of_a_table_have_their_own_order_and_the_space_its_shape() -> None:
    spec = EnvironmentSpec(id="x", action_table=((1.0, 2.0), (3.0, 4.0)), action_table_columns=(3, 0))
    space = gymnasium.spaces.Box(-4.0, 4.0, (2, 2), np.float64)
    transforms = Transforms(spec, gymnasium.spaces.Box(-1.0, 1.0, (2,)), space)
    actions = transforms.env_actions({"continuous": np.array([[0.25, -0.5]]), "table": np.array([[1]])})
    assert actions.tolist() == [[[4.0, 1.0], [-2.0, 3.0]]]
    assert actions.dtype == space.dtype


def test_a_table_over_integers_keeps_them() -> None:
    spec = EnvironmentSpec(id="x", action_table=((0.0, 3.0), (255.0, 7.0)))
    transforms = Transforms(spec, gymnasium.spaces.Box(-1, 1, (2,)), gymnasium.spaces.Box(0, 255, (2,), np.uint8))
    actions = transforms.env_actions({"action": np.array([[1], [0]])})
    assert (actions.tolist(), actions.dtype) == ([[255, 7], [0, 3]], np.uint8)


@pytest.mark.parametrize(
    ("row", "reason"),
    [
        ((0.7, 3.0), r"row 1 is \(0.7, 3.0\), but action space Box\(0, 255, \(2,\), uint8\) has integers"),
        ((300.0, 3.0), r"row 1 is \(300.0, 3.0\), outside action space Box"),
        ((-0.5, 3.0), "outside action space Box"),
    ],
)
def test_a_table_that_no_integers_fit_is_refused(row: tuple[float, float], reason: str) -> None:
    spec = EnvironmentSpec(id="x", action_table=((0.0, 0.0), row))
    with pytest.raises(EnvironmentSetupError, match=f"environment.action_table .*{reason}"):
        Transforms(spec, gymnasium.spaces.Box(-1, 1, (2,)), gymnasium.spaces.Box(0, 255, (2,), np.uint8))


def test_a_row_may_be_the_bound_of_an_action() -> None:
    spec = EnvironmentSpec(id="x", action_table=((-0.7,), (0.7,)))  # as float32 they are nearer to 0
    transforms = Transforms(spec, gymnasium.spaces.Box(-1, 1, (2,)), gymnasium.spaces.Box(-0.7, 0.7, (1,)))
    assert transforms.env_actions({"action": np.array([[1]])}) == pytest.approx(0.7)


@pytest.mark.parametrize(
    ("fields", "reason"),
    [
        ({"action_table_columns": (0,)}, "action_table_columns needs environment.action_table: set it, too"),
        ({**PEDALS, "action_table_columns": (1, 3)}, "action_table_columns names number 3, but an action of space Box"),
        ({**PEDALS, "action_table_columns": (1, 1)}, r"action_table_columns names a number twice: \[1, 1\]"),
        ({**PEDALS, "action_table_columns": (1,)}, "row 0 has 2 numbers, but action_table_columns names 1"),
        ({**PEDALS, "action_table": ((0.0, 0.0), (0.0, -0.8))}, r"row 1 is \(0.0, -0.8\), outside action space Box"),
    ],
)
def test_columns_that_do_not_fit_are_reported(fields: dict[str, Any], reason: str) -> None:
    space = gymnasium.spaces.Box(np.array([-1.0, 0.0, 0.0], np.float32), 1.0, (3,), np.float32)
    with pytest.raises(EnvironmentSetupError, match=reason):
        Transforms(EnvironmentSpec(id="x", **fields), gymnasium.spaces.Box(-1.0, 1.0, (2,)), space)


class _Telling(gymnasium.Env):
    """An environment whose observation is a text."""

    observation_space = gymnasium.spaces.Text(8)
    action_space = gymnasium.spaces.Box(-1, 1)

    def reset(self, *, seed=None, options=None):
        return "", {}


def test_unsupported_observation_space_is_named() -> None:
    gymnasium.register("Telling-v0", lambda **_kwargs: _Telling())
    with pytest.raises(EnvironmentSetupError, match=r"observation space Text.*is not supported: use Box, Discrete"):
        make_environments(EnvironmentSpec(id="Telling-v0"), 1)


@pytest.mark.parametrize("backend", ["envpool", "ale"])
def test_other_backends_refuse_gymnasium_options(backend: Literal["envpool", "ale"]) -> None:
    with pytest.raises(EnvironmentSetupError, match=f"backend={backend} does not support wrap"):
        make_environments(EnvironmentSpec(id="Pong-v5", backend=backend, wrap="corridor:wrap"), 1, modules=TEST_MODULES)
    with pytest.raises(EnvironmentSetupError, match="does not support render_mode"):
        make_environments(EnvironmentSpec(id="Pong-v5", backend=backend), 1, render_mode="human")


def test_unknown_keyword_argument_is_named() -> None:
    with pytest.raises(EnvironmentSetupError, match=r"cannot be created.*no_such_option"):
        make_environments(EnvironmentSpec(id="Acrobot-v1", kwargs={"no_such_option": 1}), 1)


class _StartsAtFive(gymnasium.Env):
    """An environment with the actions 5 and 6 only."""

    observation_space = gymnasium.spaces.Box(0, 1, (1,), np.float32)
    action_space = gymnasium.spaces.Discrete(2, start=5)

    def reset(self, *, seed=None, options=None):
        return np.zeros(1, np.float32), {}

    def step(self, action):
        assert action in (5, 6)
        return np.zeros(1, np.float32), float(action), False, False, {}


def test_action_indices_start_at_zero_for_a_discrete_space_that_does_not() -> None:
    gymnasium.register("StartsAtFive-v0", lambda **_kwargs: _StartsAtFive())
    environments = PlainEnvironments(make_environments(EnvironmentSpec(id="StartsAtFive-v0"), 2))
    environments.reset(1)
    assert choices(environments.spaces) == 2
    np.testing.assert_array_equal(environments.step(np.array([0, 1]))[1], [5.0, 6.0])


def test_the_guide_names_every_member_of_a_backend() -> None:
    guide = (Path(__file__).parents[2] / "docs" / "guides" / "backend.md").read_text()
    members = {name for name in vars(BackendEnvironments) if not name.startswith("_")}
    assert members == set(re.findall(r"`(\w+)", "".join(re.findall(r"^\| (`.*?) \|", guide, re.MULTILINE))))
    assert f"`{make_bare.__name__}`" in guide
