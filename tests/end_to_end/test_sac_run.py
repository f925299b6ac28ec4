"""`daedalus train --algorithm sac`, with real processes."""

import json
import shutil
from collections.abc import Callable
from pathlib import Path

import gymnasium
import numpy as np
from processes import Running

from daedalus.actor.environments.minari_files import Episode, MinariWriter

SHORT = ("--set", "policy.hidden=[16]", "--set", "training.replay_begin=50", "--set", "evaluation.final_episodes=0")


def summary(directory: Path) -> dict[str, int]:
    return json.loads((directory / "summary.json").read_text())


def test_sac_trains_with_defaults_and_resumes_with_its_buffer(start: Callable[..., Running], tmp_path: Path) -> None:
    pendulum = gymnasium.make("Pendulum-v1")
    shown = MinariWriter(str(tmp_path / "shown"), pendulum.observation_space, pendulum.action_space, pendulum.spec)
    still = np.tile(np.array([[1.0, 0.0, 0.0]], np.float32), (6, 1))
    shown.add(Episode(still, np.zeros((5, 1), np.float32), np.zeros(5), terminated=False, truncated=True))
    options = ("--algorithm", "sac", "--env-steps", 300, "--actors", 1, *SHORT, "--run-dir", "r")
    running = start("train", "--env", "Pendulum-v1", *options, "--demonstrations", "./shown")
    assert running.wait() == 0, running.output
    done = summary(tmp_path / "r")
    assert 300 <= done["env_steps"] < 400
    assert done["env_steps"] - 80 <= done["updates"] <= done["env_steps"] - 40  # one each, after the first 50
    shutil.rmtree(tmp_path / "shown")  # the run has a copy
    resumed = start("resume", "r", "--env-steps", 400)
    assert resumed.wait() == 0, resumed.output
    resumed.expect(r"demonstrations: 5 steps of \./shown")
    assert resumed.expect(r"replay buffer: (\d+) transitions")[1] == str(done["env_steps"])
    more = summary(tmp_path / "r")
    assert more["updates"] - done["updates"] == more["env_steps"] - done["env_steps"]  # no second beginning
