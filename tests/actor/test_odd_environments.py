"""Environments of users that keep to gymnasium's interface in ways that few do: they are checked and played."""

import logging
from contextlib import closing
from functools import partial
from typing import Any

import gymnasium
import numpy as np
import pytest
from collectors import collect, started_collector
from plain import PlainPolicy

from daedalus.actor.checking.checker import gymnasium_notes
from daedalus.actor.checking.play import check_environment
from daedalus.actor.environments.environment_errors import EnvironmentSetupError
from daedalus.actor.environments.gymnasium_environments import EnvironmentsInTurn
from daedalus.actor.environments.make import make_environments
from daedalus.policy.acting.noise import Noise
from daedalus.policy.user_modules import UserModules
from daedalus.protocol.spec import EnvironmentSpec

MODULES = UserModules(frozenset({"odd_environment"}))


def spec(name: str = "Odd-v0", **kwargs: Any) -> EnvironmentSpec:
    return EnvironmentSpec(id=f"odd_environment:{name}", kwargs=kwargs)


def problems(checked: EnvironmentSpec) -> tuple[str, ...]:
    return check_environment(checked, MODULES, seconds=60.0, env_steps=10).problems


class First(PlainPolicy):
    """A policy that always makes the first choice."""

    def choose(
        self, observations: np.ndarray, state: np.ndarray, noise: Noise
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        return np.zeros(len(observations), np.int64), np.zeros(len(observations), np.float32), state


@pytest.mark.parametrize("flags", ["", "int flags", "float flags", "reward column"])
def test_flags_of_a_vector_environment_may_be_numbers_and_rewards_a_column(flags: str) -> None:
    checked = spec("OddVector-v0", oddity=flags)
    assert problems(checked) == ()
    rollout = collect(started_collector(checked, First(), count=2, rollout_length=8, modules=MODULES))
    assert rollout.terminated.tolist() == [[row in (2, 6)] * 2 for row in range(8)]
    assert rollout.terminated.dtype == np.bool_
    np.testing.assert_array_equal(rollout.rewards, [[float(row % 4 != 3)] * 2 for row in range(8)])
    np.testing.assert_array_equal(rollout.episode_lengths, [3] * 4)
    np.testing.assert_array_equal(rollout.episode_info["score"], [30.0, 31.0] * 2)


@pytest.mark.parametrize(
    ("oddity", "text"),
    [
        ("constructor", "cannot be created: TypeError: unexpected argument"),
        ("autoreset", "its vector entry point must use gymnasium's AutoresetMode.NEXT_STEP"),
        ("step", "step raises ValueError: no such vector"),
        ("space", "its vector entry point has "),
        ("one reward", r"step returns rewards of shape (), but it must be one number for each of the 2 environments"),
        ("text", "step returns rewards of shape (), but it must be one number"),
        ("no info", "step returns info of type NoneType: it must be a dict"),
        ("complex", "reset returns an observation of type ndarray, which is not an array of numbers"),
        ("fewer rows", "reset returns 1 observations for 2 environments"),
        ("endless", "has got max_episode_steps=20, but an episode goes on after 20 steps: return truncated there"),
        ("nan", "reset returns an observation with the value nan at index 0: it must be finite"),
    ],
)
def test_faults_of_a_vector_entry_point_are_found_by_the_check(oddity: str, text: str) -> None:
    (problem,) = problems(spec("OddVector-v0", oddity=oddity))
    assert text in problem
    assert "\n" not in problem
    (other,) = {*problems(spec("OddVector-v0", oddity=oddity).model_copy(update={"action_repeat": 2})), "none"}
    assert other == "none"  # a wrapper is needed, so training does not use the vector entry point


@pytest.mark.parametrize("masks", ["lists", "map"])
def test_action_masks_may_be_lists_of_different_lengths_or_a_map(masks: str) -> None:
    checked = spec(masks=masks)
    assert problems(checked) == ()
    assert not [note for note in gymnasium_notes(checked, MODULES) if "Error" in note]
    with closing(make_environments(checked, 2, modules=MODULES)) as environments:
        observed = environments.reset(1)
        for _ in range(5):
            assert observed.masks["arm"].tolist() == [[True, False]] * 2
            assert observed.masks["legs"].tolist() == [[False, True, True, True, False]] * 2
            observed, *_ = environments.step(
                {"arm": np.zeros((2, 1), np.int64), "legs": np.array([[1, 0]] * 2)},
            )


def test_close_that_fails_is_a_warning(caplog: pytest.LogCaptureFixture) -> None:
    checked = spec(close_fails=True)
    assert problems(checked) == ()
    gymnasium_notes(checked, MODULES)
    with caplog.at_level(logging.WARNING):
        make_environments(checked, 2, modules=MODULES).close()
    (record,) = caplog.records
    assert "close raises ConnectionError: already disconnected" in record.getMessage()
    assert "odd_environment.py, line " in record.getMessage()


@pytest.mark.parametrize("processes", [False, True])
def test_component_without_a_fixed_shape_can_be_left_out(processes: bool) -> None:
    checked = spec(extra=True).model_copy(update={"leave_out": ("notes",), "processes": processes})
    with closing(make_environments(checked, 2, modules=MODULES)) as environments:
        assert environments.reset(1).frames["seen"].tolist() == [[0.0, 0.0]] * 2
        assert environments.step({"action": np.array([[0], [1]])})[1].tolist() == [1.0, 1.0]


@pytest.mark.parametrize(("drawn_by", "warns"), [("constructor", True), ("seed", False), ("reset", False)])
def test_task_that_the_constructor_draws_is_a_warning(drawn_by: str, warns: bool) -> None:
    """Each environment of a run would have a task of its own, whatever the seed."""
    report = check_environment(spec("Drawn", drawn_by=drawn_by), MODULES, seconds=60.0, env_steps=10)
    assert report.problems == ()
    assert ["draw it in reset, from self.np_random" in warning for warning in report.warnings] == [True] * warns


@pytest.mark.parametrize(("seeds", "warns"), [("42 without one", True), ("its own", False), ("always 42", False)])
def test_episodes_that_all_begin_alike_without_a_seed_are_a_warning(seeds: str, warns: bool) -> None:
    """Training would play one start, and evaluations, whose episodes all have a seed, others."""
    report = check_environment(spec("Starting", seeds=seeds), MODULES, seconds=60.0, env_steps=10)
    assert report.problems == ()
    assert ["training gives a seed to the first episode" in warning for warning in report.warnings] == [True] * warns


def test_environments_do_not_share_what_their_constructor_changes_in_place() -> None:
    given = {"options": {"masks": "lists"}}
    checked = spec("Popping", **given)
    assert problems(checked) == ()
    gymnasium_notes(checked, MODULES)
    with closing(make_environments(checked, 3, modules=MODULES)) as environments:
        assert environments.reset(1).masks["arm"].tolist() == [[True, False]] * 3
    assert checked.kwargs == given


@pytest.mark.parametrize("seed", range(8))
def test_seeds_of_training_fit_an_int_of_c(seed: int) -> None:
    rollout = collect(started_collector(spec(), First(), count=2, rollout_length=4, seed=seed, modules=MODULES))
    assert (rollout.rows, rollout.environments) == (4, 2)


class Simulator(gymnasium.Env[Any, Any]):
    """An environment whose `close` raises an exception, and which cannot be made for the lack of a licence."""

    observation_space, action_space = gymnasium.spaces.Discrete(2), gymnasium.spaces.Discrete(2)

    def __init__(self, number: int, closed: list[int], licensed: bool = True) -> None:
        self._number, self._closed = number, closed
        if not licensed:
            raise ConnectionError("all licences are in use")

    def close(self) -> None:
        self._closed.append(self._number)
        raise RuntimeError(f"{self._number} has no connection")


def test_environments_are_closed_if_another_cannot_be_made() -> None:
    """Simulators that were started would go on, and occupy the ports of those that the next process starts."""
    closed: list[int] = []
    makers = [partial(Simulator, number, closed, licensed=number != 3) for number in range(1, 5)]
    with pytest.raises(EnvironmentSetupError, match="licences"):
        EnvironmentsInTurn("Simulator-v0", makers)
    assert closed == [1, 2]


def test_environment_of_which_only_one_can_run_is_reported_with_the_remedy() -> None:
    makers = [partial(Simulator, number, [], licensed=number == 1) for number in range(1, 9)]
    with pytest.raises(EnvironmentSetupError) as caught:
        EnvironmentsInTurn("Simulator-v0", makers)
    place, hint = str(caught.value).split(")", 1)[0], str(caught.value).rpartition(" (")[2]
    assert place.startswith("environment Simulator-v0 cannot be created: ConnectionError: all licences are in use (")
    assert hint == (
        "environment 2 of 8 of this process: if only one can run at a time, use --set collection.envs_per_actor=1 "
        "--actors 1)"
    )
    with pytest.raises(EnvironmentSetupError) as caught:
        EnvironmentsInTurn("Simulator-v0", makers[1:])
    assert "only one can run" not in str(caught.value), "the first cannot be made, either"


def test_all_environments_are_closed_once_though_one_raises() -> None:
    closed: list[int] = []
    environments = EnvironmentsInTurn("Simulator-v0", [partial(Simulator, number, closed) for number in range(1, 4)])
    with pytest.raises(RuntimeError, match="1 has no connection"):
        environments.close()
    environments.close()
    assert closed == [1, 2, 3]
