"""Scalars of `info` at the end of an episode: which travel, and that they are in the rollout where it ends."""

from typing import Any

import gymnasium
import numpy as np
import pytest
from allowed_modules import TEST_MODULES
from collectors import collect, started_collector
from counting_environment import Counting
from plain import PlainPolicy

from daedalus.actor.checking.play import check_environment
from daedalus.actor.environments.info import EpisodeInfo, info_to_keep
from daedalus.protocol.spec import EnvironmentSpec

ENDED = np.array([True, False, True, True])


def taken(info: dict[str, Any], ended: np.ndarray = ENDED) -> dict[str, list[float]]:
    scalars = EpisodeInfo()
    scalars.add(info, ended)
    return {name: values.tolist() for name, values in scalars.take().items()}


def test_scalars_of_ended_episodes_are_taken_once() -> None:
    scalars = EpisodeInfo()
    scalars.add({"laps": np.array([1, 2, 3, 4])}, ENDED)
    scalars.add({"laps": np.array([5.5, 6.5, 7.5, 8.5])}, np.array([False, True, False, False]))
    scalars.add({"laps": np.array([9, 9, 9, 9])}, np.zeros(4, np.bool_))
    (name,), (values,) = zip(*scalars.take().items(), strict=True)
    assert (name, values.dtype, values.tolist()) == ("laps", np.float64, [1.0, 3.0, 4.0, 6.5])
    assert scalars.take() == {}


def test_environments_that_gave_no_value_are_left_out() -> None:
    given = {"crashed": np.array([True, True, False, False]), "_crashed": np.array([True, True, False, True])}
    assert taken(given) == {"crashed": [1.0, 0.0]}


@pytest.mark.parametrize(
    "info",
    [
        {"image": np.zeros((4, 3, 3))},
        {"name": np.array(["a", "b", "c", "d"])},
        {"object": np.array([None] * 4)},
        {"episode": {"r": np.zeros(4)}},
        {"_hidden": np.zeros(4)},
        {"a/b": np.zeros(4), "": np.zeros(4), "x" * 65: np.zeros(4), "\x1b[2J": np.zeros(4)},
        {7: np.ones(4), (1, 2): np.ones(4), None: np.ones(4)},
        {"infinite": np.array([np.nan, 1.0, np.inf, 1e300])},
    ],
)
def test_other_entries_are_left_out(info: dict[Any, Any]) -> None:
    assert taken(info) == {}


def test_only_scalars_and_masks_are_kept() -> None:
    mask = np.ones(3, np.int8)
    scalars = {
        "a": 1,
        "b": True,
        "c": 2.5,
        "d": np.float32(0.5),
        "e": np.uint64(2**63),
        "f": np.array(4),
        "g": np.True_,
    }
    others = {8: 1.0, "_h": 1.0, "i j": 1.0, "k": None, "l": "2", "m": 1j, "n": np.ones(1), "o": 10**400, "p": {"q": 1}}
    kept = info_to_keep({**scalars, **others, "action_mask": mask}, ended=True)
    assert kept.pop("action_mask") is mask
    assert kept == {"a": 1.0, "b": 1.0, "c": 2.5, "d": 0.5, "e": 2.0**63, "f": 4.0, "g": 1.0}
    assert {type(value) for value in kept.values()} == {float}  # gymnasium gives a batch the type of its first value
    assert list(info_to_keep({**scalars, "action_mask": mask}, ended=False)) == ["action_mask"]


def test_names_and_values_are_limited() -> None:
    names = taken({f"name{number}": np.zeros(4) for number in range(20)})
    assert list(names) == [f"name{number}" for number in range(16)]
    assert len(taken({"a": np.zeros(300)}, np.ones(300, np.bool_))["a"]) == 256


class Reporting(Counting):
    """Counting that reports its episode and step, and at the end of an episode how many steps it had."""

    def __init__(self, **arguments: Any) -> None:
        super().__init__(**arguments)

    def step(self, action: np.int64) -> tuple[np.ndarray, float, bool, bool, dict]:
        observation, reward, terminated, truncated, _ = super().step(action)
        info = {"episode": self._episode, "text": "no scalar"}
        if terminated or truncated:
            info["steps"] = float(self._step)
        return observation, reward, terminated, truncated, info


@pytest.mark.parametrize("repeat", [1, 2])
def test_rollout_has_the_scalars_of_the_episodes_that_ended_in_it(repeat: int) -> None:
    """Episodes of 3, 2 and 1 steps, with a reset row between them."""
    gymnasium.register("Reporting-v0", Reporting)
    try:
        spec = EnvironmentSpec(id="Reporting-v0", action_repeat=repeat)
        collector = started_collector(spec, PlainPolicy(), count=2, rollout_length=4 if repeat == 1 else 3)
        found = [{name: values.tolist() for name, values in collect(collector).episode_info.items()} for _ in range(2)]
        collector.close()
    finally:
        del gymnasium.registry["Reporting-v0"]
    assert found[0] == {"episode": [0.0, 0.0], "steps": [3.0, 3.0]}
    assert found[1]["episode"][:2] == [1.0, 1.0]
    assert found[1]["steps"][:2] == [2.0, 2.0]


@pytest.mark.parametrize(
    ("info", "text"),
    [
        ({"laps": 1, "_hidden": 2, "eval/laps": "three"}, ""),
        ({"laps": 1, "eval/laps": 1.5}, "info has the number 'eval/laps' at the end of an episode, which becomes no"),
        ({"success rate": np.float32(1.0)}, "info has the number 'success rate'"),
        ({f"n{number}": number for number in range(16)} | {"text": "no number"}, ""),
        (
            {f"n{number}": number for number in range(17)},
            "17 numbers at the end of an episode, and only 16 become metr",
        ),
    ],
)
def test_the_check_names_numbers_that_become_no_metric(
    info: dict[str, Any], text: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(Counting, "step", step_with(info, Counting.step))
    spec = EnvironmentSpec(id="counting_environment:Counting-v0")
    warnings = check_environment(spec, TEST_MODULES, seconds=60.0, env_steps=40).warnings
    assert [text in each for each in warnings if "info has" in each] == ([True] if text else [])


def step_with(info: dict[str, Any], step: Any) -> Any:
    return lambda self, action: (*step(self, action)[:4], info)
