"""`daedalus train --algorithm sac`, with real processes."""

import json
from collections.abc import Callable
from pathlib import Path

from processes import Running

SHORT = ("--set", "policy.hidden=[16]", "--set", "training.replay_begin=50", "--set", "evaluation.final_episodes=1")


def summary(directory: Path) -> dict[str, int]:
    return json.loads((directory / "summary.json").read_text())


def test_sac_trains_with_defaults_and_resumes_with_its_buffer(start: Callable[..., Running], tmp_path: Path) -> None:
    running = start("train", "--env", "Pendulum-v1", "--algorithm", "sac", "--env-steps", 300, *SHORT, "--run-dir", "r")
    assert running.wait() == 0, running.output
    done = summary(tmp_path / "r")
    assert 300 <= done["env_steps"] < 400
    assert done["env_steps"] - 80 <= done["updates"] <= done["env_steps"] - 40  # one each, after the first 50
    resumed = start("resume", "r", "--env-steps", 400)
    assert resumed.wait() == 0, resumed.output
    assert resumed.expect(r"replay buffer: (\d+) transitions")[1] == str(done["env_steps"])
    more = summary(tmp_path / "r")
    assert more["updates"] - done["updates"] == more["env_steps"] - done["env_steps"]  # no second beginning
