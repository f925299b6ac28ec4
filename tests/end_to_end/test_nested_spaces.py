"""Test that nested observations and actions with masks are learned over a real router."""

import json
import shutil
from collections.abc import Callable
from pathlib import Path

import nested_environment
from nested_environment import SETTINGS, TARGET
from processes import Running

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
