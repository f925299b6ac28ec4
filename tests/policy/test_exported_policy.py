"""`daedalus export` and `Policy.export`: the file, played by plain onnxruntime, against the policy itself."""

import json
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import gymnasium
import numpy as np
import onnx
import onnxruntime
import pytest
from gymnasium import spaces as gym
from saved_runs import CARTPOLE, COUNTING, save

import daedalus
from daedalus.actor.environments.components import leaves
from daedalus.actor.environments.transforms import Transforms
from daedalus.actor.evaluation.export_check import ExportedPlayer
from daedalus.actor.evaluation.exported_policy import ExportOptions, inputs_and_outputs
from daedalus.actor.evaluation.loaded_policy import exported_bytes
from daedalus.cli.commands.export import export
from daedalus.learner.run.settings import preset_names, read_preset
from daedalus.policy.saving.saved_policy import read_policy
from daedalus.policy.saving.sealed import SealedDirectory, write_sealed
from daedalus.protocol.spec import EnvironmentSpec

OBSERVATIONS = 300


class Case(NamedTuple):
    """A policy's architecture and the environment's own spaces."""

    observed: gymnasium.Space
    acted: gymnasium.Space
    settings: Mapping[str, Any] = {}
    environment: Mapping[str, Any] = {}
    masked: bool = False


IMAGE = gym.Box(0, 255, (96, 96, 3), np.uint8)
WHEEL = gym.Box(np.array([-1, 0, 0], np.float32), np.array([1, 1, 1], np.float32))
NESTED = gym.Dict(
    {
        "camera": gym.Dict(
            {"image": gym.Box(0, 255, (3, 40, 38), np.uint8), "far": gym.Box(-2.0, 2.0, (), np.float64)}
        ),
        "code": gym.MultiDiscrete([3, 2], start=[1, -1]),
        "action": gym.MultiBinary(3),
        "left": gym.Box(-1, 1, (2,)),
    }
)
PARTS = gym.Dict(
    {
        "action": gym.Discrete(4, start=2),
        "0": gym.Tuple((gym.Box(0.0, 2.0, (2, 2), np.float64), gym.MultiBinary((2, 2)))),
        "free": gym.Box(np.array([0, -np.inf], np.float32), np.array([np.inf, np.inf], np.float32)),
        "whole": gym.Box(-3, 7, (2,), np.int16),
        "wide": gym.Box(-1e6, 1e6, (1,)),
        "fixed": gym.Box(0.0, 0.0, (2,)),
    }
)
BOARD = gym.Dict({"observation": gym.Box(0, 1, (3, 3, 2), np.int8), "action_mask": gym.Box(0, 1, (9,), np.int8)})
CASES = {
    "nested": Case(NESTED, PARTS, {"encoder": "small"}, {"crop": (1, 2, 3, 0), "resize": (24, 21), "frame_stack": 3}),
    "mixed": Case(
        IMAGE,
        WHEEL,
        {"encoder": "impala", "distribution": "kumaraswamy"},
        {
            **{"grey": True, "crop": (0, 12, 0, 0), "resize": (21, 24), "frame_stack": 2},
            **{"action_table": ((0.0, 0.0), (1.0, 0.5)), "action_table_columns": (1, 2)},
        },
    ),
    "recurrent": Case(
        gym.Box(-9, 9, (5,)),
        gym.Box(-1, 1, (2,)),
        {
            **{"memory": "gru", "normalize_observations": True, "distribution": "gaussian_mixture"},
            "state_dependent_std": True,
        },
    ),
    "squashed": Case(gym.Discrete(5, start=1), gym.Box(-1, 3, (2,)), {"distribution": "squashed_gaussian"}),
    "masked": Case(gym.Box(-9, 9, (5,)), gym.Tuple((gym.Discrete(3), gym.MultiDiscrete([2, 3]))), masked=True),
    "several agents": Case(gym.Dict({**BOARD.spaces, "agent": gym.Discrete(2)}), gym.Discrete(9)),
    "action values": Case(gym.Box(-9, 9, (5,)), gym.Discrete(3), {"training": {"algorithm": "n_step_q"}}),
}
# What their environments show, by the preset; the networks are the presets' own.
SPACES = {
    "car_racing": (IMAGE, WHEEL),
    "pong": (gym.Box(0, 255, (210, 160, 3), np.uint8), gym.Discrete(6)),
    "connect_four": (
        gym.Dict({"observation": gym.Box(0, 1, (6, 7, 2), np.int8), "action_mask": gym.Box(0, 1, (7,), np.int8)}),
        gym.Discrete(7),
    ),
    "tic_tac_toe": (BOARD, gym.Discrete(9)),
    "cartpole": (gym.Box(-5, 5, (4,)), gym.Discrete(2)),
    "acrobot": (gym.Box(-5, 5, (6,)), gym.Discrete(3)),
    "lunar_lander": (gym.Box(-5, 5, (8,)), gym.Discrete(4)),
}
MOVING = (gym.Box(-np.inf, np.inf, (17,), np.float64), gym.Box(-1, 1, (6,)))


def case_of(name: str) -> Case:
    if name in CASES:
        return CASES[name]
    preset = read_preset(name)
    found = [spaces for start, spaces in SPACES.items() if name.startswith(start) and "continuous" not in name[12:]]
    observed, acted = found[0] if found else MOVING
    unneeded = ("id", "backend", "kwargs", "training_kwargs", "max_episode_steps", "no_reward_limit")
    environment = {key: value for key, value in preset["environment"].items() if key not in unneeded}
    settings = {"training": preset["training"], **preset.get("policy", {})}
    return Case(observed, acted, settings, environment)


def policy_of(folder: Path, case: Case) -> daedalus.Policy:
    """Save a run of untrained weights, and load its policy."""
    environment = EnvironmentSpec.model_validate({"id": "CartPole-v1", **case.environment})
    masks = {"0": np.ones((1, 3), np.bool_), "1": np.ones((1, 5), np.bool_)} if case.masked else None
    spaces = Transforms(environment, case.observed, case.acted, masks).spaces
    policy = {"hidden": (24,), **case.settings}
    training = policy.pop("training", {})
    gain = 1.0 if policy.get("memory") == "gru" else 2.0  # larger ones make a memory chaotic
    training = {"algorithm": training.get("algorithm", "a2c")}
    save(folder, environment, 1, spaces=spaces, gain=gain, policy=policy, training=training)
    return daedalus.load_policy(folder, observation_space=case.observed, action_space=case.acted)


@pytest.mark.parametrize("name", [*CASES, *preset_names()])
def test_file_chooses_the_actions_of_the_policy(tmp_path: Path, name: str) -> None:
    case = case_of(name)
    policy = policy_of(tmp_path / "run", case)
    policy.observation_space.seed(4)
    random = np.random.default_rng(4)
    player = ExportedPlayer.of(policy, exported_bytes(policy, ExportOptions(rows=2 if name == "nested" else None)))
    seen = set()
    images = any(leaf.space.dtype == np.uint8 for leaf in leaves(policy.observation_space, "observation"))
    for number in range(200 if images else OBSERVATIONS):
        if number % 100 == 0:
            player.reset()
        observation, mask = policy.observation_space.sample(), None
        if case.masked:
            mask = {
                "0": random.permutation([True, False, True]),
                "1": np.array([True, True, *random.permutation([0, 1, 1])]),
            }
        elif isinstance(observation, dict) and "action_mask" in observation:
            observation["action_mask"][random.integers(len(observation["action_mask"]))] = 1
        for leaf in leaves(policy.observation_space, "observation"):
            if leaf.space.dtype == np.uint8:  # rows of a different brightness: all noise would look the same
                image = leaf.of(observation)
                image >>= random.integers(0, 8, (len(image), 1, 1), np.uint8)
        action = player.act(observation, action_mask=mask)
        if number % 10 == 0:
            seen.add(str(action))
    repeat = policy.spec.environment.action_repeat
    assert (player.choices, player.different) == (
        (2 if images else 3) * -(-100 // repeat),
        0,
    )  # the numbers of an action to 1e-5
    assert len(seen) > 1 or name in ("pong", "car_racing_article")  # to whose networks all noise looks alike


@pytest.mark.parametrize("name", ["masked", "recurrent"])
def test_sampled_file_makes_its_samples_from_uniform_numbers(tmp_path: Path, name: str) -> None:
    policy = policy_of(tmp_path / "run", CASES[name])
    player = ExportedPlayer.of(policy, exported_bytes(policy, ExportOptions(sampled=True, rows=1)))
    masks = {"0": np.array([True, False, True]), "1": np.ones(5, np.bool_)} if CASES[name].masked else None
    observation = np.zeros(5, np.float32)
    seen = [str(player.act(observation, sampled=True, action_mask=masks)) for _ in range(50)]
    assert player.different == 0
    assert len(set(seen)) > 5
    player.reset(seed=0)
    assert [str(player.act(observation, sampled=True, action_mask=masks)) for _ in range(50)] == seen


def test_policy_repeats_an_action_no_longer_than_its_mask_allows(tmp_path: Path) -> None:
    policy = policy_of(tmp_path / "run", Case(BOARD, gym.Discrete(9), environment={"action_repeat": 3}))
    empty = np.zeros((3, 3, 2), np.int8)
    legal = [[2, 3], [2, 3], [3], [3, 4], [3, 4], [5], [6]]
    played = [
        policy.act({"observation": empty, "action_mask": np.isin(range(9), each).astype(np.int8)}) for each in legal
    ]
    assert [action in each for action, each in zip(played, legal, strict=True)] == [True] * 7
    assert len(set(played[:2])) == len(set(played[2:5])) == 1


def test_file_says_what_is_left_to_the_caller(tmp_path: Path) -> None:
    policy = policy_of(
        tmp_path / "run", CASES["squashed"]._replace(environment={"wrap": "my:scaled", "action_repeat": 2})
    )
    assert inputs_and_outputs(exported_bytes(policy, ExportOptions()))[-1] == (
        "left to the caller: wrap the environment with my:scaled; give each action 2 times"
    )


def test_command_checks_the_file_and_says_what_is_inside(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    run, path = save(tmp_path / "run", COUNTING, 7), tmp_path / "policy.onnx"
    words = ["--check", "--licence", "MIT", "--rows", "1", "--quantize", "int8", "--episodes", "2"]
    assert export([str(run), str(path), *words]) == 2
    assert "type: daedalus export" in capfd.readouterr().err
    assert not path.exists()
    assert export([str(run), str(path), *words, "--allow-module", "counting_environment"]) == 0
    printed = capfd.readouterr().out
    assert "inputs: observation" in printed
    assert "check: in 100 steps, " in printed
    assert "return over 2 episodes: " in printed
    session = onnxruntime.InferenceSession(path)
    metadata = session.get_modelmeta().custom_metadata_map
    assert metadata["licence"] == "MIT"
    assert (metadata["daedalus.run"], metadata["daedalus.policy_version"]) == ("run", "7")
    assert metadata["daedalus.version"] == daedalus.__version__
    (described,) = json.loads(metadata["daedalus.spaces"])["observations"]
    assert (described["name"], described["kind"]) == ("observation", "Box")
    states = json.loads(metadata["daedalus.states"])
    assert {entry.name for entry in session.get_inputs()} == {"observation", *states}
    assert {entry.name for entry in session.get_outputs()} == {"action", *(each["next"] for each in states.values())}


def test_a_file_has_the_operators_that_converters_and_old_runtimes_know(tmp_path: Path) -> None:
    policy = daedalus.load_policy(save(tmp_path / "run", CARTPOLE, 1, policy={"memory": "gru"}))
    policy.export(tmp_path / "policy.onnx", rows=1)
    model = onnx.load(tmp_path / "policy.onnx")
    assert (model.ir_version, [(each.domain, each.version) for each in model.opset_import]) == (8, [("", 17)])
    assert not {node.op_type for node in model.graph.node} & {"Shape", "Expand", "ConstantOfShape", "Range"}


@pytest.mark.parametrize(("quantize", "most"), [("float16", 2e-3), ("int8", 0.1)])
def test_smaller_numbers_choose_nearly_the_same_actions(tmp_path: Path, quantize: Any, most: float) -> None:
    """Also of observations and actions that float16 does not have: their nodes keep float32."""
    settings = {"distribution": "squashed_gaussian", "normalize_observations": True}
    policy = policy_of(tmp_path / "run", Case(gym.Box(1e5 - 9, 1e5 + 9, (5,)), gym.Box(-1e6, 3e6, (2,)), settings))
    normalizer = {
        "normalizer.means.0": np.repeat(np.array([[99_840.0], [160.0], [0.0]], np.float32), 5, 1),  # summands
        "normalizer.scales.0": np.full(5, 0.25, np.float32),
    }
    policy._saved = replace(policy._saved, weights={**policy._saved.weights, **normalizer})
    policy._runtime.load(policy._saved.weights)
    model = exported_bytes(policy, ExportOptions(quantize=quantize))
    player = ExportedPlayer.of(policy, model)
    policy.observation_space.seed(1)
    for _ in range(50):
        player.act(policy.observation_space.sample())
    assert 0.0 < player.largest_difference < most
    sizes = {each.data_type for each in onnx.load_model_from_string(model).graph.initializer}
    assert {"float16": onnx.TensorProto.FLOAT16, "int8": onnx.TensorProto.UINT8}[quantize] in sizes


def test_an_action_that_is_no_number_differs(tmp_path: Path) -> None:
    policy = policy_of(tmp_path / "run", Case(gym.Box(-1e9, 1e9, (5,)), gym.Box(-1, 1, (2,))))
    player = ExportedPlayer.of(policy, exported_bytes(policy, ExportOptions(quantize="float16")))
    player.act(np.array([1e9, -1e9, 1e9, -1e9, 1e9], np.float32))  # which float16 does not have
    assert (player.different, player.largest_difference) == (1, np.inf)


def test_bad_input_is_refused_in_one_line(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    run, path = save(tmp_path / "run", CARTPOLE, 1), tmp_path / "policy.onnx"
    path.write_text("mine")
    q = save(tmp_path / "q", CARTPOLE, 1, training={"algorithm": "n_step_q"})
    (tmp_path / "empty").mkdir()
    sealed = SealedDirectory(run / "checkpoints" / "0000000001")
    program = onnx.load_model_from_string(read_policy(run / "checkpoints" / "0000000001").program)
    program.graph.node[0].op_type = "RandomNormal"
    files = {"program.onnx": program.SerializeToString(), "parameters.safetensors": b""}
    files["parameters.safetensors"] = sealed.read("parameters.safetensors", 1 << 20)
    write_sealed(tmp_path / "odd", files, sealed.content)
    new = tmp_path / "new.onnx"
    for words, reason in (
        ([run, path], "exists and is left as it is"),
        ([run, tmp_path / "nowhere" / "policy.onnx"], "is no folder"),
        ([tmp_path / "empty", new], "has no checkpoints"),
        ([tmp_path / "odd", new], "uses the operator 'RandomNormal'"),
        ([q, new, "--sampled"], "takes the best of its action values"),
        ([run, new, "--rows", "0"], "rows is 0"),
        ([new], "name either a run directory"),
    ):
        assert export([str(word) for word in words]) in (1, 2)
        (line,) = capfd.readouterr().err.splitlines()
        assert reason in line
    assert path.read_text() == "mine"
    assert not new.exists()
    assert {each.name for each in tmp_path.iterdir()} == {"run", "q", "empty", "odd", "policy.onnx"}
