"""Test that nested observations and actions with masks are learned over a real router."""

import json
import shutil
import time
from collections.abc import Callable
from pathlib import Path

import gymnasium
import nested_environment
from nested_environment import SETTINGS, TARGET
from processes import LIMIT, Running

from daedalus import Client

Start = Callable[..., Running]


def options(directory: Path, *settings: str) -> list[object]:
    shutil.copy(nested_environment.__file__, directory)
    words = [word for setting in (*SETTINGS, *settings) for word in ("--set", setting)]
    return ["--env", "nested_environment:NestedMasked-v0", "--run-dir", "run", *words]


def summary(directory: Path) -> dict:
    return json.loads((directory / "run" / "summary.json").read_text())


def test_actors_learn_nested_spaces_with_masks(start: Start, tmp_path: Path) -> None:
    many = ("collection.envs_per_actor=32", "collection.rollout_length=16", "evaluation.final_episodes=20")
    running = start("train", *options(tmp_path, *many), "--env-steps", 200_000)
    assert running.wait() == 0, running.output
    result = summary(tmp_path)
    assert result["solved"] is True
    assert result["rollouts_rejected"].keys() <= {"stale"}
    assert result["evaluation_return_mean"] > TARGET - 0.5  # greedy actions of the learned policy


def test_a_client_is_trained_on_in_nested_spaces_with_masks(start: Start, address: str, tmp_path: Path) -> None:
    few = ("collection.rollout_length=64", "training.batch_rollouts=2", "training.stop_when_solved=false")
    learner = start("learner", *options(tmp_path, *few), "--env-steps", 1000, "--listen", address, "--actors", 1)
    robot = gymnasium.make("NestedMasked-v0")
    observation, info = robot.reset(seed=1)
    deadline = time.monotonic() + LIMIT
    with Client(
        address,
        observation_space=robot.observation_space,
        action_space=robot.action_space,
        action_mask=info["action_mask"],
        timeout=LIMIT,
    ) as client:
        while not client.is_over:
            assert time.monotonic() < deadline, learner.output
            observation, reward, terminated, _, info = robot.step(client.act(observation, info["action_mask"]))
            client.reward(float(reward))
            if terminated:
                client.end_episode(terminated=True)
                observation, info = robot.reset()
    assert learner.wait() in (0, 3), learner.output
    result = summary(tmp_path)
    assert (result["env_steps"] >= 1000, result["updates"] >= 8) == (True, True)
    assert result["rollouts_rejected"].keys() <= {"stale"}
