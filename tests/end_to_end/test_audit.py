"""Test that no process of a run unpickles anything: an audit hook ends a process that does."""

import json
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest
from processes import ENDLESS, PLAYING_SLOW, SLOW, Running


@pytest.fixture(autouse=True)
def audit_hook(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PYTHONPATH", str(Path(__file__).parent.parent / "audit"))


def test_the_audit_hook_ends_a_process_that_unpickles() -> None:
    program = "import pickle; pickle.loads(pickle.dumps(print))"
    ended = subprocess.run([sys.executable, "-P", "-c", program], capture_output=True, text=True, check=False)
    assert (ended.returncode, ended.stderr[:9]) == (97, "UNPICKLED")


def test_training_resuming_and_evaluating_unpickle_nothing(start: Callable[..., Running], tmp_path: Path) -> None:
    saving = ("--set", "service.checkpoint_seconds=0.2", "--set", "evaluation.seconds=0.2")
    few = ("--actors", 1, "--set", "evaluation.episodes=2", "--set", "evaluation.final_episodes=2")
    few = (*few, "--set", "environment.max_episode_steps=20")
    first = start("train", "cartpole", *ENDLESS, *SLOW, "--run-dir", "run", *saving, *few)
    first.expect("evaluation at")
    first.process.terminate()
    assert first.wait() == 1, first.output
    env_steps = json.loads((tmp_path / "run" / "summary.json").read_text())["env_steps"]
    again = start("resume", "run", "--env-steps", env_steps + 100, *PLAYING_SLOW)
    assert again.wait() in (0, 3), again.output
    assert json.loads((tmp_path / "run" / "summary.json").read_text())["evaluation_return_mean"] > 5
    assert (tmp_path / "run" / "checkpoints").is_dir()
    assert "UNPICKLED" not in first.output + again.output
