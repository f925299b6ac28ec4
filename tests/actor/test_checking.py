"""actor/checking: what is found in environments with faults, and in good ones."""

import math
import re
from typing import Any, Literal

import gymnasium
import numpy as np
import pytest
from allowed_modules import TEST_MODULES
from building import run_spec
from gymnasium.envs.registration import EnvSpec
from gymnasium.spaces import Box, Dict, Discrete, MultiBinary, Tuple
from gymnasium.wrappers import NormalizeObservation
from plain import plain_spaces

from daedalus.actor.checking.check_report import (
    EnvironmentReport,
    advice,
    float_images,
    never_ends,
    slow_steps,
    stacked_images,
    uninformative_bounds,
)
from daedalus.actor.checking.checker import gymnasium_notes, square_maps
from daedalus.actor.checking.play import check_environment, unsaved_statistics
from daedalus.actor.checking.violations import observation_violations, step_violations
from daedalus.actor.environments.precision import Precision
from daedalus.policy.user_modules import UserModules
from daedalus.protocol.spaces import ArraySpace, ContinuousSpace, DiscreteSpace, Spaces
from daedalus.protocol.spec import EnvironmentSpec, RunSpec

BOOL: Any = np.bool_  # as MinAtar has it, though Box is not typed for it
FAULTY = "faulty_environments:Faulty-v0"
MODULES = UserModules(frozenset({"faulty_environments"}))


def check(fault: str = "", seconds: float = 60.0, **settings: object) -> EnvironmentReport:
    spec = EnvironmentSpec.model_validate({"id": FAULTY, "kwargs": {"fault": fault}, **settings})
    return check_environment(spec, MODULES, seconds=seconds, env_steps=25)


@pytest.mark.parametrize(
    ("fault", "message"),
    [
        ("shape", "reset returns an observation of shape (3,), but observation_space has shape (2,) (at first)"),
        ("dtype", "reset returns an observation of type ndarray, which is not an array of numbers"),
        ("nan", "reset returns an observation with the value nan at index 1: it must be finite"),
        ("none", "reset returns an observation of type NoneType, which is not an array of numbers"),
        ("reset", "reset returns one value of type ndarray; it must return a tuple (observation, info)"),
        ("values", "step returns a tuple of 4 (ndarray, float, bool, bool); it must return a tuple (observation, rew"),
        ("reward", "step returns the reward nan: it must be finite (after 3 env_steps)"),
        ("error", "step raises KeyError: 'missing' ("),
    ],
)
def test_a_fault_is_one_problem_of_one_line(fault: str, message: str) -> None:
    wrapped = ({"max_episode_steps": 5}, {"action_repeat": 2})
    for settings in ({}, *(wrapped if fault not in ("reward", "reset") else ())):  # they change the count or the call
        (problem,) = check(fault, **settings).problems
        assert problem.startswith(f"environment {FAULTY}: {message}")
        assert "\n" not in problem


def test_an_error_of_the_users_code_names_its_line() -> None:
    for fault in ("error", "constructor"):
        (problem,) = check(fault).problems
        assert "faulty_environments.py, line " in problem
    assert (
        check("constructor")
        .problems[0]
        .startswith(f"environment {FAULTY} cannot be created: FileNotFoundError: level.txt (")
    )


def test_what_does_not_stop_training_is_a_warning_given_once() -> None:
    report = check("bounds")
    assert report.warnings == (
        f"environment {FAULTY}: reset returns an observation with the value 731.5 at index 1, "
        "but observation_space goes from -1 to 1 (at first)",
        f"environment {FAULTY}: step returns an observation with the value 731.5 at index 1, "
        "but observation_space goes from -1 to 1 (after 1 env_steps)",
    )
    assert not report.problems
    space, above = Box(0.0, 1.0, (1,)), np.array([np.nextafter(np.float32(1.0), np.float32(2.0))])
    ((_, text),) = observation_violations(space, above, "step")
    assert "the value 1.0000001 at index 0, but observation_space goes from 0 to 1" in text, "not 1 beyond 1"
    (flag,) = check("flag").warnings
    assert "step returns terminated=0, of type int: it must be a bool" in flag


class Batched(gymnasium.Env):
    """An environment of any two spaces, whose values are of another dtype, or cannot be batched."""

    def __init__(self, observations: gymnasium.Space, actions: gymnasium.Space, observation: Any) -> None:
        self.observation_space, self.action_space, self._observation = observations, actions, observation

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        return self._observation, {}

    def step(self, action: Any) -> Any:
        return self._observation, 0.0, False, False, {}


@pytest.mark.parametrize(
    ("observations", "actions", "observation", "kind"),
    [
        (MultiBinary(4), Discrete(2), np.zeros(4), "observation"),
        (Box(-1, 1, (1,)), Dict(a=Discrete(2), b=Dict()), np.zeros(1), "action"),
    ],
)
def test_what_an_actor_cannot_batch_is_a_problem(
    observations: gymnasium.Space,
    actions: gymnasium.Space,
    observation: Any,
    kind: str,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """One environment alone can be played."""
    monkeypatch.setitem(gymnasium.registry, "Batched-v0", EnvSpec("Batched-v0", disable_env_checker=True))
    made: Any = lambda: Batched(observations, actions, observation)  # noqa: E731 - of any type
    gymnasium.registry["Batched-v0"].entry_point = made
    (problem,) = check_environment(EnvironmentSpec(id="Batched-v0"), MODULES, seconds=60.0, env_steps=3).problems
    assert problem.startswith(f"environment Batched-v0: gymnasium cannot make a batch of the {kind}s, as actors do (")


def test_a_good_environment_is_measured() -> None:
    report = check()
    assert (report.problems, report.warnings) == ((), ())
    assert (report.env_steps, report.lengths, report.returns) == (25, (10, 10), (10.0, 10.0))
    assert report.step_seconds > 0.0
    assert report == EnvironmentReport.model_validate_json(report.model_dump_json())


class Sensors(gymnasium.Env):
    """Two sensors and episodes of 20 steps; `changes`: the sensors that show the step, others show the episode."""

    observation_space = Dict(camera=Box(0, 255, (8, 8, 3), np.uint8), joint=Box(0.0, 1000.0, (1,), np.float32))
    action_space = Discrete(2)

    def __init__(self, changes: list[str], stopped: bool = False) -> None:
        self.changes, self.number, self.steps, self.stopped = changes, 0, 0, stopped

    def observe(self) -> dict[str, np.ndarray]:
        shown = {
            name: self.steps if name in self.changes else 0 if self.stopped else self.number
            for name in ("camera", "joint")
        }
        return {
            "camera": np.full((8, 8, 3), shown["camera"], np.uint8),
            "joint": np.array([shown["joint"]], np.float32),
        }

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        self.number, self.steps = self.number + 1, 0
        return self.observe(), {}

    def step(self, action: Any) -> Any:
        self.steps += 1
        return self.observe(), 0.0, self.steps == 20, False, {}


def test_observations_that_stand_still_are_a_warning(monkeypatch: pytest.MonkeyPatch) -> None:
    made: Any = Sensors
    monkeypatch.setitem(gymnasium.registry, "Sensors-v0", EnvSpec("Sensors-v0", disable_env_checker=True))
    gymnasium.registry["Sensors-v0"].entry_point = made

    def warned(steps: int, *changes: str, stopped: bool = False) -> list[str]:
        spec = EnvironmentSpec(id="Sensors-v0", kwargs={"changes": list(changes), "stopped": stopped})
        report = check_environment(spec, UserModules(), seconds=60.0, env_steps=steps)
        return [warning.removeprefix("environment Sensors-v0: ") for warning in report.warnings]

    (nothing,) = warned(100)  # each episode has another picture
    assert nothing.startswith("the observation has changed in none of 95 rows within an episode, so that the policy ca")
    assert nothing.endswith("only with --set environment.kwargs.render_mode=rgb_array")
    assert warned(50) == []  # too early
    assert warned(100, "joint") == warned(100, "camera", "joint") == []  # the camera may show the goal of the episode
    (camera,) = warned(100, "joint", stopped=True)
    assert camera.startswith("observation component 'camera' is the same in all 95 rows and 5 episodes so far: if it ")
    assert warned(50, "joint", stopped=True) == warned(55, "joint", stopped=True) == []


@pytest.mark.parametrize(
    ("shown", "warns"),
    [
        ({"legal_moves": [2, 0]}, True),
        ({"legal_moves": {1}}, True),
        ({"valid_actions": np.array([True, False, True])}, True),
        ({"avail_actions": [0, 1, 1]}, True),
        ({"action_mask": np.array([1, 0, 1], np.int8), "valid": [1, 1, 1]}, False),
        ({"valid_moves": 2, "is_legal": True, "legal": [[1], [0, 2]], "valid": [0.5, 1.0, 0.0], "mask": "101"}, False),
        ({"legal_moves": [3]}, False),  # of another thing than the three choices
        ({"scores": [0, 1, 1]}, False),
    ],
)
def test_mask_under_a_name_that_is_not_read_is_a_warning(
    shown: dict[str, Any], warns: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    class Board(Sensors):
        action_space = Discrete(3)

        def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
            return super().reset(seed=seed)[0], shown

        def step(self, action: Any) -> Any:
            return *super().step(action)[:4], shown

    monkeypatch.setitem(gymnasium.registry, "Board-v0", EnvSpec("Board-v0", disable_env_checker=True))
    made: Any = Board
    gymnasium.registry["Board-v0"].entry_point = made
    spec = EnvironmentSpec(id="Board-v0", kwargs={"changes": ["joint"], "stopped": False})
    report = check_environment(spec, UserModules(), seconds=60.0, env_steps=20)
    assert report.problems == ()
    assert ["which of the 3 choices are legal" in warning for warning in report.warnings] == [True] * warns


@pytest.mark.parametrize(
    ("space", "is_map"),
    [
        (Box(0, 1, (10, 10, 4), BOOL), True),
        (Box(0, 1, (8, 8, 2), np.int8), True),
        (MultiBinary((10, 10, 4)), True),
        (Box(0.0, 1.0, (10, 10, 4)), False),  # any numbers
        (Box(0, 255, (10, 10, 4), np.uint8), False),
        (Box(0, 1, (10, 12, 4), BOOL), False),
        (Box(0, 1, (6, 6, 4), BOOL), False),
        (Box(0, 1, (64, 64, 4), BOOL), False),
        (Box(0, 1, (10, 10), BOOL), False),
    ],
)
def test_small_boards_of_flags_are_maps(space: gymnasium.Space, is_map: bool) -> None:
    assert square_maps(space) == ("observation",) * is_map
    assert square_maps(Dict(board=space, turn=Discrete(2))) == ("board",) * is_map


def test_without_play_only_the_spaces_are_read() -> None:
    report = check("nan", seconds=0.0)
    assert report.spaces is not None
    assert (report.problems, report.env_steps) == ((), 0)


def test_choices_that_do_not_count_from_0_are_reported() -> None:
    modules = UserModules(frozenset({"nested_environment"}))
    nested = check_environment(EnvironmentSpec(id="nested_environment:Nested-v0"), modules, seconds=0.0, env_steps=1)
    assert nested.first_choices == {"observation sensors.code": (2,)}


def test_a_module_that_is_not_allowed_is_not_imported() -> None:
    report = check_environment(EnvironmentSpec(id="os:Nothing-v0"), MODULES, seconds=1.0, env_steps=1)
    assert report.spaces is None
    assert "may not be imported here" in report.problems[0]


@pytest.mark.parametrize("backend", ["envpool", "gymnasium"])
def test_environments_that_exist_as_vectors_only_are_played(backend: str) -> None:
    if backend == "envpool":
        pytest.importorskip("envpool")
        spec = EnvironmentSpec(id="CartPole-v1", backend="envpool")
    else:
        spec = EnvironmentSpec(id="phys2d/CartPole-v1") if "phys2d/CartPole-v1" in gymnasium.registry else None
        pytest.importorskip("jax")
    assert spec is not None
    report = check_environment(spec, MODULES, seconds=60.0, env_steps=200)
    assert not report.problems
    assert report.env_steps == 200
    assert report.lengths


def test_random_actions_are_rows_of_the_action_table() -> None:
    settings = {"id": "Pendulum-v1", "action_table": ((-2.0,), (2.0,))}
    report = check_environment(EnvironmentSpec.model_validate(settings), MODULES, seconds=60.0, env_steps=10)
    assert (report.problems, report.env_steps, report.time_limit) == ((), 10, 200)


def test_observations_of_several_parts_are_checked_part_by_part() -> None:
    space = Dict({"camera": Box(0, 255, (2, 2), np.uint8), "joints": Tuple([Discrete(3), Box(-1, 1, (1,))])})
    good = {"camera": np.zeros((2, 2), np.uint8), "joints": (2, np.zeros(1, np.float32))}
    assert not list(observation_violations(space, good, "step"))
    bad = [
        ({**good, "joints": (3, np.zeros(1, np.float32))}, "whose part 'joints' is whose part 0 is 3, which is not in"),
        ({"camera": good["camera"]}, "with the parts ['camera'], but observation_space has the parts"),
        ({**good, "camera": np.zeros((3, 2), np.uint8)}, "whose part 'camera' is of shape (3, 2), but observation_"),
        ({**good, "camera": np.zeros((2, 2), np.float32)}, "of dtype float32, but observation_space['camera'] has"),
        (np.zeros(2), "of type ndarray, but observation_space has the parts"),
        ({**good, "joints": (2, np.array([-2e15]))}, "with the value -2e+15 at index 0: it must be within +-1e+15"),
    ]
    for value, message in bad:
        ((kind, text),) = observation_violations(space, value, "step")
        assert kind == "problem"
        assert message in text


def test_surplus_parts_of_an_observation_are_a_warning_as_nobody_reads_them() -> None:
    space = Dict({"joints": Tuple([Discrete(3)])})
    ((kind, text),) = observation_violations(space, {"joints": (1,), "extra": None}, "step")
    assert kind == "warning"
    assert "with the parts ['extra', 'joints'], but observation_space has the parts ['joints']" in text
    found = list(observation_violations(space, {"joints": (3,), "extra": None}, "step"))
    assert [kind for kind, _ in found] == ["warning", "problem"]


@pytest.mark.parametrize(
    ("flag", "kind"),
    [
        *[(flag, "problem") for flag in ("False", [True, False], [[True], [True, False]], 2, math.nan, {})],
        *[(flag, "warning") for flag in (0, 1.0, None, np.array([True]))],
    ],
    ids=str,
)
def test_end_that_is_no_bool(flag: object, kind: str) -> None:
    result = np.zeros(2, np.float32), 0.0, False, flag, {}
    ((found, text),) = step_violations(Box(-1, 1, (2,)), result)
    assert found == kind
    assert text.endswith("it must be a bool")


@pytest.mark.parametrize("reward", [[1.0], "1.0a", None, np.array([1.0, 2.0])], ids=str)
def test_reward_that_is_no_number_is_a_problem(reward: object) -> None:
    result = np.zeros(2, np.float32), reward, False, False, {}
    ((kind, text),) = step_violations(Box(-1, 1, (2,)), result)
    assert kind == "problem"
    assert text.endswith("it must be a number")


def test_integer_that_no_float_holds_is_no_finite_reward() -> None:
    ((kind, text),) = step_violations(Box(-1, 1, (2,)), (np.zeros(2, np.float32), 10**400, False, False, {}))
    assert (kind, text) == ("problem", "step returns the reward inf: it must be finite")


@pytest.mark.parametrize(
    ("settings", "is_problem"),
    [({}, True), ({"reward_scale": 1e-4}, False), ({"reward_clip": 1.0}, False), ({"reward_scale": 0.1}, True)],
)
def test_reward_that_the_learner_rejects_is_a_problem(settings: dict[str, float], is_problem: bool) -> None:
    report = check("large reward", **settings)
    text = "step returns the reward -1e+12, but learning takes rewards within +-1e+09: set environment.reward_scale"
    assert report.problems == ((f"environment {FAULTY}: {text} (after 1 env_steps)",) if is_problem else ())


@pytest.mark.parametrize("attribute", ["observation_space", "action_space"])
def test_environment_without_a_space_is_one_problem(attribute: str) -> None:
    (problem,) = check(f"no {attribute}").problems
    assert problem.startswith(f"environment {FAULTY} has no {attribute} (AttributeError: ")
    assert problem.endswith("): set it in the constructor")
    assert "\n" not in problem


def test_space_of_evaluations_must_be_that_of_training() -> None:
    """Else only the evaluation after the whole training would fail."""
    (problem,) = check("", training_kwargs={"fault": "three numbers"}).problems
    assert problem == (
        f"environment {FAULTY}: evaluations, which play it without environment.training_kwargs, have observation: "
        "float32 array of shape (2,); action: 2 choices, but training has observation: float32 array of shape (3,); "
        "action: 2 choices"
    )
    (problem,) = check("constructor", training_kwargs={"fault": ""}).problems
    assert problem.startswith(f"environment {FAULTY} cannot be created: FileNotFoundError: level.txt (")
    assert problem.endswith(" (evaluations play it without environment.training_kwargs)")
    assert check("", training_kwargs={"never_ends": True}).problems == ()


@pytest.mark.parametrize(
    ("wrapper", "setting"),
    [("NormalizeObservation", "policy.normalize_observations"), ("NormalizeReward", "training.normalize_rewards")],
)
@pytest.mark.parametrize("play", [True, False])
def test_wrapper_with_statistics_that_are_not_saved_is_a_warning(wrapper: str, setting: str, play: bool) -> None:
    spec = EnvironmentSpec(id="Pendulum-v1", wrap=f"gymnasium.wrappers:{wrapper}", action_repeat=2)
    modules = UserModules(frozenset({"gymnasium.wrappers"}))
    (warning,) = check_environment(spec, modules, seconds=60.0 if play else 0.0, env_steps=5).warnings
    assert f"wrapper {wrapper} has statistics of its own in each environment, which are not saved: " in warning
    assert f"use --set {setting}=true in its place" in warning


def test_statistics_that_do_not_change_are_no_warning() -> None:
    environment = NormalizeObservation(gymnasium.make("Pendulum-v1"))
    assert len(unsaved_statistics(environment)) == 1
    environment.update_running_mean = False  # loaded by the user
    assert unsaved_statistics(environment) == ()


def mission(
    *missions: str, leave_out: tuple[str, ...] = (), seconds: float = 60.0, repeat: int = 1
) -> EnvironmentReport:
    spec = EnvironmentSpec(
        id="mission_environment:Mission-v0",
        kwargs={"missions": list(missions)},
        leave_out=leave_out,
        action_repeat=repeat,
    )
    return check_environment(spec, TEST_MODULES, seconds=seconds, env_steps=25)


@pytest.mark.parametrize("seconds", [0.0, 60.0])
def test_text_that_never_changes_is_left_out_and_reported(seconds: float) -> None:
    report = mission("open the door", seconds=seconds)
    assert report.problems == mission("open the door", seconds=seconds, repeat=2).problems == ()
    assert report.constant_texts == {"mission": "open the door"}
    assert report.spaces is not None
    assert list(report.spaces.observations) == ["step"]
    assert (
        "is a text, which the policy cannot read: --set \"environment.leave_out=['mission']\""
        in report.text_problem(spec())
    )
    named = mission("open the door", leave_out=("mission",), seconds=seconds)
    assert (named.spaces, named.constant_texts, named.text_problem(spec())) == (report.spaces, {}, "")


def test_text_that_changes_is_a_problem() -> None:
    (problem,) = mission("open the door", "close the door").problems
    assert "observation component 'mission' is a text that changes ('" in problem
    assert "--set \"environment.leave_out=['mission']\"" in problem
    assert mission("open the door", "close the door", leave_out=("mission",)).problems == ()


@pytest.mark.parametrize("leave_out", [(), ("mission",)])
def test_text_that_is_left_out_need_not_be_of_its_space(leave_out: tuple[str, ...]) -> None:
    spec = EnvironmentSpec(id="mission_environment:Mission-v0", kwargs={"text_space": True}, leave_out=leave_out)
    report = check_environment(spec, TEST_MODULES, seconds=60.0, env_steps=25)
    assert (report.problems, report.env_steps) == ((), 25)


def test_gymnasiums_own_checker_adds_notes() -> None:
    notes = gymnasium_notes(EnvironmentSpec(id=FAULTY, kwargs={"fault": "bounds"}), MODULES)
    assert notes
    assert all(note.startswith("gymnasium's checker: ") and "\x1b" not in note for note in notes)


def spec(**collection: object) -> RunSpec:
    return run_spec().model_copy(
        update={"collection": run_spec().collection.model_copy(update={"envs_per_actor": 16, **collection})}
    )


def test_slow_continuous_steps_suggest_sac() -> None:
    arm, choice = ContinuousSpace(low=(-1.0,), high=(1.0,)), DiscreteSpace(counts=(2,))
    free = ContinuousSpace(low=(None,), high=(None,))

    def proposes(
        action: ContinuousSpace | DiscreteSpace, seconds: float, memory: str = "none", **training: Any
    ) -> bool:
        spaces = Spaces(observations={"o": ArraySpace(shape=(3,), dtype="float32")}, actions={"a": action})
        policy = {"distribution": "squashed_gaussian", "state_dependent_std": True, "memory": memory}
        run = RunSpec.model_validate({"environment": {"id": "Any-v0"}, "policy": policy, "training": training})
        found = advice(EnvironmentReport(spaces=spaces, step_seconds=seconds), run, processors=2)
        return any("training.algorithm=sac" in text for text in found)

    assert proposes(arm, 0.021)
    assert not proposes(arm, 0.019)
    assert not proposes(arm, 0.021, algorithm="sac")
    assert not proposes(arm, 0.021, memory="gru")
    assert not proposes(arm, 0.021, algorithm="appo", curiosity=1.0)
    assert not proposes(choice, 0.021)
    assert not proposes(free, 0.021)


def test_slow_steps_suggest_processes_where_they_help() -> None:
    waiting = EnvironmentReport(step_seconds=0.2, busy_share=0.0)
    busy = EnvironmentReport(step_seconds=0.2, busy_share=1.0)
    slow = slow_steps(waiting, spec(rollout_length=16), processors=2)
    assert slow == (
        "a step takes 200 ms, and an actor steps its 16 environments in turn: 3.2 s a row, 51.2 s a rollout"
    )
    noted = advice(waiting, spec(rollout_length=16), processors=2)
    assert noted == [f"{slow}; use --set environment.processes=true"]
    assert slow_steps(busy, spec(), processors=16)
    assert not slow_steps(busy, spec(), processors=2)  # its actors use both processors
    assert not slow_steps(waiting, spec(envs_per_actor=1), processors=2)
    assert not slow_steps(EnvironmentReport(step_seconds=0.001, busy_share=0.0), spec(), processors=2)
    assert not slow_steps(waiting.model_copy(update={"vectorized": True}), spec(), processors=2)
    for other in ({"id": "Any-v0", "processes": True}, {"id": "Any-v0", "processes": False}, {"id": "python:Any"}):
        own = spec().model_copy(update={"environment": EnvironmentSpec.model_validate(other)})
        assert not slow_steps(waiting, own, processors=2)


def test_an_environment_without_an_end_is_noted() -> None:
    endless = check("", kwargs={"never_ends": True})
    assert "no episode ended within 25 env_steps of random actions" in never_ends(endless, spec())
    assert not never_ends(check(), spec())
    assert not never_ends(endless.model_copy(update={"time_limit": 500}), spec())


@pytest.mark.parametrize(
    ("found", "settings", "noted"),
    [
        ({"lengths": (30,) * 10}, {}, True),
        ({"lengths": (30,) * 9}, {}, False),
        ({"lengths": (30, 30, 12) * 4}, {}, False),
        ({"lengths": (30,) * 10, "truncations": 5}, {}, False),
        ({"lengths": (1,) * 12}, {}, False),
        ({"lengths": (30,) * 10}, {"bootstrap_terminations": True}, False),
    ],
)
def test_terminations_as_by_a_time_limit_are_noted(
    found: dict[str, Any], settings: dict[str, bool], noted: bool
) -> None:
    chosen = spec().model_copy(update={"environment": spec().environment.model_copy(update=settings)})
    notes = advice(EnvironmentReport(**found), chosen, processors=2)
    assert ["return truncated in place of terminated" in note for note in notes] == [True] * noted


def test_truncations_are_counted() -> None:
    for limit, truncations in ((3, 8), (None, 0)):
        report = check(max_episode_steps=limit)
        assert report.truncations == truncations, "episodes of Faulty terminate after 10 steps; 25 are played"


@pytest.mark.parametrize(
    ("shape", "dtype", "noted"),
    [
        ((3, 40, 40), "float32", True),
        ((40, 40, 3), "float32", True),
        ((40, 40, 3), "uint8", False),
        ((40, 40), "float32", False),  # rather a matrix
        ((3, 4, 40), "float32", False),
    ],
)
def test_an_image_of_floats_is_noted(shape: tuple[int, ...], dtype: Literal["float32", "uint8"], noted: bool) -> None:
    report = EnvironmentReport(spaces=plain_spaces(ArraySpace(shape=shape, dtype=dtype), 2))
    assert bool(advice(report, spec(), processors=2)) is noted
    assert ("if it is an image, return bytes from 0 to 255" in float_images(report, spec())) is noted
    chosen = spec().model_copy(update={"policy": spec().policy.model_copy(update={"encoder": "nature"})})
    assert not float_images(report, chosen)


@pytest.mark.parametrize("dtype", ["float32", "uint8"])
@pytest.mark.parametrize(
    ("shape", "noted"), [((4, 96, 96, 3), True), ((4, 1, 84, 84), True), ((4, 9, 9, 3), False), ((96, 96, 3), False)]
)
def test_several_images_in_one_array_are_noted(
    shape: tuple[int, ...], dtype: Literal["float32", "uint8"], noted: bool
) -> None:
    report = EnvironmentReport(spaces=plain_spaces(ArraySpace(shape=shape, dtype=dtype), 2))
    found = [text for text in advice(report, spec(), processors=2) if "environment.frame_stack" in text]
    assert bool(found) is noted
    chosen = spec().model_copy(update={"policy": spec().policy.model_copy(update={"encoder": "mlp"})})
    assert not stacked_images(report, chosen)


@pytest.mark.parametrize(
    ("shape", "settings", "text"),
    [
        (
            (160, 120, 3),
            {"grey": True, "resize": (84, 84)},
            "is made grey and 84 x 84 pixels small for the policy: if colours matter, use --set "
            "environment.grey=false; if small details matter, --set environment.resize=[HEIGHT,WIDTH]",
        ),
        ((160, 120, 1), {"resize": (84, 84)}, "is made 84 x 84 pixels small for the policy: if small details matter"),
        ((84, 84, 1), {"resize": (84, 84)}, ""),  # the user's own transforms are in the spaces
        ((160, 120, 3), {}, ""),
    ],
)
def test_what_default_settings_remove_from_images_is_noted(
    shape: tuple[int, ...], settings: dict[str, object], text: str
) -> None:
    report = EnvironmentReport(spaces=plain_spaces(ArraySpace(shape=shape, dtype="uint8"), 2))
    chosen = spec().model_copy(update={"environment": spec().environment.model_copy(update=settings)})
    notes = advice(report, chosen, processors=2)
    assert [text in note for note in notes] == ([True] if text else [])


@pytest.mark.parametrize(
    ("shape", "noted"), [((8, 10, 10), True), ((10, 10, 8), False), ((6, 7, 2), False), ((10, 10, 10), False)]
)
def test_map_whose_planes_may_come_first_is_noted(shape: tuple[int, ...], noted: bool) -> None:
    report = EnvironmentReport(spaces=plain_spaces(ArraySpace(shape=shape, dtype="float32"), 2))
    chosen = spec().model_copy(update={"policy": spec().policy.model_copy(update={"encoder": "grid"})})
    notes = advice(report, chosen, processors=2)
    assert ["8 x 10 cells with 10 planes: if it has 8 planes of 10 x 10" in note for note in notes] == [True] * noted
    assert not advice(report, spec(), processors=2)


@pytest.mark.parametrize(
    ("value", "policy", "remedy"),
    [
        (9, {"encoder": "mlp", "codes": {"observation": (9,)}}, "has the value 9 where policy.codes.observation has 9"),
        (3, {}, ", and the encoder divides bytes by 255: if its values are codes, such as kinds of things, and not"),
        (3, {}, "use --set policy.codes.observation=[4] --set policy.encoder=mlp, with as many codes as there can be"),
        (3, {"encoder": "mlp"}, "use --set policy.codes.observation=[4], with as many codes as there can be"),
        (3, {"encoder": "mlp", "normalize_observations": True}, "'observation' has no value above 3: if its values"),
        (3, {"encoder": "mlp", "codes": {"observation": (9,)}}, ""),
        (3, {"encoder": "module:Own"}, ""),
        (0, {}, ""),  # nothing is shown yet
        (200, {}, ""),
    ],
)
def test_image_of_small_values_is_noted(value: int, policy: dict[str, object], remedy: str) -> None:
    """Its numbers may be codes, and are nearly equal after the division by 255."""
    report = check("map", kwargs={"fault": "map", "value": value})
    assert report.problems == ()
    assert report.byte_maxima == {"observation": (value,)}
    chosen = spec().model_copy(update={"policy": spec().policy.model_copy(update=policy)})
    notes = [text for text in advice(report, chosen, processors=2) if "policy.codes" in text]
    notes += filter(None, [report.code_problem(chosen)])
    assert [remedy in text for text in notes] == ([True] if remedy else [])


def test_minigrids_codes_are_told_from_its_pictures() -> None:
    """Both are declared as bytes from 0 to 255, and pictures of one pixel a cell have the same shape."""
    pytest.importorskip("minigrid")

    def codes(**settings: object) -> dict[str, tuple[int, ...]]:
        spec = EnvironmentSpec.model_validate({"id": "MiniGrid-LavaGapS5-v0", "leave_out": ("mission",), **settings})
        wrappers = UserModules(frozenset({"minigrid.wrappers"}))
        report = check_environment(spec, wrappers, seconds=0.0, env_steps=0)
        assert not report.problems
        return report.codes

    assert codes() == codes(wrap="minigrid.wrappers:FullyObsWrapper") == {"image": (11, 6, 4)}
    assert codes(wrap="minigrid.wrappers:RGBImgPartialObsWrapper") == {}
    assert codes(wrap="minigrid.wrappers:FlatObsWrapper", leave_out=()) == {}


@pytest.mark.parametrize(
    ("low", "high", "noted"),
    [
        ((-1.0, -1000.0), (1.0, 1000.0), ""),
        ((-1.0, 0.0), (1.0, None), "is not bounded on both sides"),
        ((-1.0, -1e9), (1.0, 1e9), "goes from -1e+09 to 1e+09"),
    ],
)
def test_bounds_that_say_nothing_about_useful_actions_are_noted(
    low: tuple[float | None, ...], high: tuple[float | None, ...], noted: str
) -> None:
    spaces = plain_spaces(ArraySpace(shape=(2,), dtype="float32"), 2)
    continuous = spaces.model_copy(update={"actions": {"action": ContinuousSpace(low=low, high=high)}})
    advice = uninformative_bounds(EnvironmentReport(spaces=continuous))
    assert advice == "" if not noted else f"action 'action' {noted}" in advice
    assert not uninformative_bounds(EnvironmentReport(spaces=spaces))
    assert not uninformative_bounds(EnvironmentReport())


# ------------------------------------------------------------------------------------- what float32 cannot hold


def precision_warnings(shown: list[Any], space: str, **kwargs: Any) -> tuple[str, ...]:
    spec = EnvironmentSpec(id="showing_environments:Showing-v0", kwargs={"shown": shown, "space": space, **kwargs})
    modules = UserModules(frozenset({"showing_environments"}))
    report = check_environment(spec, modules, seconds=60.0, env_steps=len(shown) - 1)
    assert report.problems == ()
    return tuple(warning for warning in report.warnings if "float32" in warning)


@pytest.mark.parametrize(
    ("shown", "space", "reason"),
    [
        (
            [1_700_000_000, 1_700_000_001],
            "int64",
            "has the value 1,700,000,001, which becomes 1,700,000,000 in float32",
        ),
        ([1_700_000_000, 1_700_000_001], "float64", "has the value 1,700,000,001, which becomes 1,700,000,000"),
        ([0, 16_777_217], "int32", "has the value 16,777,217, which becomes 16,777,216"),
        ([0, 4_000_000_001], "uint32", "has the value 4,000,000,001"),
        ([1.7e9 + 0.1 * step for step in range(9)], "float64", "changes by about 0.1, but .* are 128 apart"),
        ([5_800_000.2 + 0.03 * step for step in range(9)], "float64", "changes by about 0.03, but .* are 0.5 apart"),
        ([52.52 + 1e-7 * step for step in range(9)], "float64", "changes by about 1e-07, but .* are 3.81e-06 apart"),
    ],
)
def test_numbers_that_float32_merges_are_a_warning(shown: list[Any], space: str, reason: str) -> None:
    (warning,) = precision_warnings(shown, space)
    assert re.search(f"observation component 'observation' .*{reason}.*: in a wrapper", warning)


def test_rewards_that_float32_merges_are_a_warning() -> None:
    (warning,) = precision_warnings([0.0] * 3, "float64", rewards=[0, 1e8 + 1, 1e8 + 2])
    assert "the reward has the value 100,000,001, which becomes 100,000,000 in float32" in warning
    assert warning.endswith("scale it or subtract a constant before it becomes float32")


@pytest.mark.parametrize(
    ("shown", "space"),
    [
        ([16_777_216, 5, -3], "int64"),
        ([0.1 * step for step in range(9)], "float64"),
        ([1e6 + 10.3 * step for step in range(9)], "float64"),
        ([9.81] * 9, "float64"),
        ([9.81 * (1 + 2e-16 * step) for step in range(9)], "float64"),  # its own rounding
    ],
)
def test_numbers_that_float32_tells_apart_are_no_warning(shown: list[Any], space: str) -> None:
    assert precision_warnings(shown, space) == ()


@pytest.mark.parametrize(
    ("low", "high", "dtype", "warns"),
    [
        (1_600_000_000, 1_800_000_000, np.int64, True),
        (0, 2**31 - 1, np.int32, False),  # what is usual there is not known
        (1.7e9, 1.7e9 + 3600, np.float64, True),
        (5_800_000.0, 5_900_000.0, np.float64, False),
        (-np.inf, np.inf, np.float64, False),
    ],
)
def test_bounds_between_which_float32_is_coarse_are_a_warning(low: Any, high: Any, dtype: Any, warns: bool) -> None:
    warnings = Precision(gymnasium.spaces.Dict({"t": gymnasium.spaces.Box(low, high, (2,), dtype)})).warnings
    assert list(warnings) == (["t"] if warns else [])
