"""Test of environments that are objects of the calling program: classes, functions and instances, played by forks."""

import json
import subprocess
import sys
import textwrap
from pathlib import Path
from typing import Any

import pytest
from processes import LIMIT, processes_mentioning

PARITY = '''
import gymnasium
import numpy as np


class Parity(gymnasium.Env):
    """Eight steps; a reward for each action that names the sign of the first of `size` numbers."""

    action_space = gymnasium.spaces.Discrete(2)

    def __init__(self, size=2):
        self.observation_space = gymnasium.spaces.Box(-1.0, 1.0, (size,), np.float32)
        self.steps = 0

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.steps = 0
        return self._look(), {}

    def step(self, action):
        reward = float((self._seen[0] > 0) == action)
        self.steps += 1
        return self._look(), reward, self.steps == 8, False, {}

    def _look(self):
        self._seen = self.np_random.uniform(-1.0, 1.0, self.observation_space.shape).astype(np.float32)
        return self._seen
'''
BEGIN = """
import json
import sys

import daedalus

SETTINGS = {"evaluation.final_episodes": 0, "policy.hidden": [16], "service.log_seconds": 0.2}
FEW = {"actors": 2, "settings": {**SETTINGS, "collection.rollout_length": 16}, "quiet": True}


def refused(call, *arguments, **settings):
    try:
        call(*arguments, **settings)
    except (daedalus.SettingsError, daedalus.TrainingError, daedalus.EnvironmentSetupError, ValueError) as error:
        return str(error)


def seen(result):
    return {"steps": result.env_steps, "mean": result.evaluation_return_mean, "solved": result.solved}
"""


def run(folder: Path, program: str) -> dict[str, Any]:
    """Run a program, and return what its only line has as JSON: all that it calls is quiet."""
    (folder / "program.py").write_text(BEGIN + textwrap.dedent(program))
    ended = subprocess.run(
        [sys.executable, "program.py"], cwd=folder, capture_output=True, text=True, timeout=LIMIT, check=False
    )
    assert ended.returncode == 0, ended.stdout + ended.stderr
    assert not processes_mentioning(str(folder))
    (line,) = ended.stdout.splitlines()
    return json.loads(line)


@pytest.mark.skipif(sys.platform != "linux", reason="forks")
def test_a_class_of_the_program_trains_stops_resumes_and_is_evaluated(tmp_path: Path) -> None:
    """The target is confirmed, too, by a process that the learner cannot start. Torch has used its threads before."""
    program = f"""
    import torch
    {textwrap.indent(PARITY, "    ").strip()}

    class First(daedalus.Callback):
        def on_metrics(self, run, row):
            if row.get("updates"):
                run.stop("once is enough")

        def on_end(self, run):
            found["callback"] = daedalus.load_policy(run.directory).observation_space.shape

    if __name__ == "__main__":
        torch.ones(600, 600) @ torch.ones(600, 600)
        size, found = 3, {{}}
        first = daedalus.train(env=lambda: Parity(size), run_dir="run", env_steps=10**9, callback=First(), **FEW)
        found |= {{"reason": first.stop_reason, "first": seen(first)}}
        found["without"] = refused(daedalus.resume, "run")
        found["other"] = refused(daedalus.resume, "run", env=Parity)
        found["named"] = refused(daedalus.resume, "run", env="CartPole-v1")
        second = daedalus.resume(
            "run",
            env=lambda: Parity(3),
            env_steps=10**6,
            settings={{"training.target_return": 6.5, "training.target_episodes": 20}},
            quiet=True,
        )
        found |= {{"second": seen(second), "confirmed": second.confirmation_return_mean}}
        found["evaluated"] = daedalus.evaluate("run", env=lambda: Parity(3), episodes=5).return_mean
        found["lost"] = refused(daedalus.evaluate, "run", episodes=5)
        print(json.dumps(found))
    """
    found = run(tmp_path, textwrap.dedent(program))
    assert found["reason"] == "once is enough"
    assert 'id = "python:lambda"' in (tmp_path / "run" / "config.toml").read_text()
    assert "continue in Python, with daedalus.resume('run', env=...)" in found["without"]
    assert found["callback"] == [3]
    assert "the environment is another than that of the run: observation observation is" in found["other"]
    assert "env is CartPole-v1, and the environment of the run in run is python:lambda" in found["named"]
    assert found["second"]["steps"] > found["first"]["steps"]
    assert found["second"]["solved"]
    assert found["confirmed"] >= 6.5
    assert found["evaluated"] > 6.0
    assert "pass it again, with daedalus.resume(RUN_DIR, env=...)" in found["lost"]


@pytest.mark.skipif(sys.platform != "linux", reason="forks")
def test_an_instance_has_one_actor_and_stays_as_it_was(tmp_path: Path) -> None:
    (tmp_path / "parity.py").write_text(PARITY)
    program = """
    import zenoh
    from parity import Parity

    if __name__ == "__main__":
        instance = Parity()
        found = {"several": refused(daedalus.train, env=instance, **FEW)}
        evaluated = {**SETTINGS, "evaluation.final_episodes": 1}
        result = daedalus.train(env=instance, run_dir="run", env_steps=600, settings=evaluated, quiet=True)
        found |= {"result": seen(result)}
        found |= {"played": instance.steps, "spec": instance.spec is None}
        found["evaluated"] = daedalus.evaluate("run", env=instance, episodes=3).return_mean
        zenoh.open(zenoh.Config.from_json5('{mode: "peer", scouting: {multicast: {enabled: false}}}')).close()
        found["after zenoh"] = refused(daedalus.train, env=instance, env_steps=600)
        print(json.dumps(found))
    """
    found = run(tmp_path, program)
    assert "env is one instance, and 2 actors with 1 environments each need more" in found["several"]
    assert found["result"]["steps"] >= 600
    assert (found["played"], found["spec"]) == (0, True)
    assert 0.0 <= found["evaluated"] <= 8.0
    assert "this program has opened a Zenoh session" in found["after zenoh"]
