"""Roles with different spaces: a learner for each, shared actors, a learner that is killed, runs that are over."""

import json
import os
import signal
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from processes import Running, processes_mentioning, until

from daedalus.launch.actor_process import ActorOptions

Start = Callable[..., Running]

GAME = '''
import time

import numpy as np
from gymnasium.spaces import Box, Discrete
from pettingzoo import ParallelEnv


class Chase(ParallelEnv):
    """Two hunters see more than the hare; ten steps."""

    metadata = {"name": "chase"}
    possible_agents = ["hunter_0", "hunter_1", "hare_0"]

    def observation_space(self, agent):
        return Box(-1.0, 1.0, (2 if agent == "hare_0" else 3,), np.float32)

    def action_space(self, agent):
        return Discrete(3)

    def reset(self, seed=None, options=None):
        self.agents, self.left = list(self.possible_agents), 10
        return self.seen(), {agent: {} for agent in self.agents}

    def step(self, actions):
        time.sleep(0.002)  # two learners leave the processors to others
        self.left -= 1
        here, over = self.agents, self.left == 0
        same = float(actions["hunter_0"] == actions["hare_0"])
        rewards = {agent: -same if agent == "hare_0" else same for agent in here}
        seen = self.seen()
        self.agents = [] if over else here
        return seen, rewards, dict.fromkeys(here, over), dict.fromkeys(here, False), {agent: {} for agent in here}

    def seen(self):
        sizes = {agent: self.observation_space(agent).shape for agent in self.agents}
        return {agent: np.full(size, 0.1 * self.left - 0.5, np.float32) for agent, size in sizes.items()}
'''
OPTIONS = (
    *("--set", "service.checkpoint_seconds=0.3", "--set", "evaluation.final_episodes=2", "--actors", 1),
    *("--set", "collection.envs_per_actor=4", "--set", "collection.rollout_length=32"),
)


def env_steps(run: Path) -> int:
    """Return the env_steps in the last line of the metrics of a run."""
    lines = (run / "metrics.csv").read_text().splitlines() if (run / "metrics.csv").exists() else []
    return int(float(lines[-1].split(",")[lines[0].split(",").index("env_steps")])) if len(lines) > 1 else 0


def test_each_role_has_a_run_of_its_own(start: Start, address: str, tmp_path: Path) -> None:
    (tmp_path / "chase.py").write_text(GAME)
    game = ("--env", "chase:Chase", "--set", "environment.backend=pettingzoo")
    runs = {role: tmp_path / f"runs/chase/chase-{role}" for role in ("hunter", "hare")}
    check = start("check", *game)
    given = start("train", *game, "--run-dir", tmp_path / "given", "--set", "league.sides=[['hunter_0'], ['hunter_1']]")
    assert check.wait() == 1
    check.expect(r"different spaces \(hunter_0, hunter_1; hare_0\).* `daedalus train` starts a learner for each role")

    assert given.wait() == 2
    given.expect("environment.agents and league.sides follow from the roles of this game: leave them out")
    assert not (tmp_path / "given").exists()

    train = start(
        "train", *game, *OPTIONS, "--run-dir", tmp_path / "runs/chase", "--env-steps", 10**9,
        "--set-role", "hare", "training.learning_rate=0.0005",
    )  # fmt: skip
    for role, run in runs.items():
        train.expect(rf"^{role}: .*return .* env_steps .*/s")
        until(lambda run=run: list((run / "checkpoints").glob("*/seal")))
    (learner,) = processes_mentioning(f"--prepared\0{runs['hunter']}")
    os.kill(learner, signal.SIGKILL)
    train.expect("hunter: the learner was killed by signal 9; started again")
    train.expect("^hunter: resuming from checkpoint")
    before = {role: env_steps(run) for role, run in runs.items()}
    until(lambda: all(env_steps(run) > before[role] for role, run in runs.items()))  # both learn again
    train.process.terminate()
    assert train.wait() == 1, train.output
    train.expect("stopped; continue with: daedalus resume .*runs/chase --allow-module chase")
    assert not processes_mentioning(str(runs["hare"]))
    assert "learning_rate = 0.0005" in (runs["hare"] / "config.toml").read_text()
    assert "learning_rate = 0.0005" not in (runs["hunter"] / "config.toml").read_text()

    steps = max(env_steps(run) for run in runs.values())
    resume = ("resume", "runs/chase", "--allow-module", "chase", "--env-steps", steps + 300)
    resumed = start(*resume)
    assert resumed.wait() == 0, resumed.output
    for role, run in runs.items():
        resumed.expect(f"^{role}: evaluation: return .* over 2 ")
        assert json.loads((run / "summary.json").read_text())["env_steps"] >= steps + 300
    again = start(*resume)
    assert again.wait() == 0
    again.expect("nothing to do: the runs of hare, hunter are over")

    # One role learns on, against the last policy of the other.
    router = start("router", "--listen", address)
    router.expect("listening")
    learner_ = start(
        "learner", "--connect", address, "--run-dir", runs["hare"], "--resume", "--env-steps", steps + 900,
        "--allow-module", "chase",
    )  # fmt: skip
    seats = ("--seat", f"hunter={runs['hunter']}", "--seat", "hare=chase-hare")
    actor = start("actor", "--connect", address, *seats, "--allow-module", "chase")
    actor.expect("the policy of run 'chase-hunter' plays hunter until the other runs are over")
    assert learner_.wait() == 0, learner_.output
    assert actor.wait() == 0, actor.output


@pytest.mark.parametrize(
    ("options", "reason"),
    [
        ({"seats": [("hare", "one")], "run": "two"}, "--seat names the runs: leave out --run"),
        ({"seats": [("hare", "one")], "evaluator": True}, "leave out --run, --any-run and --evaluator"),
        ({"seats": [("hare", "runs/one")]}, "name a run with a learner"),
        ({"seats": [("hare", "runs/one"), ("hunter", "one")]}, "a run and its directory"),
        ({"seats": [("hare", "a run")]}, "run 'a run' must be 1 to 64 letters"),
    ],
)
def test_seats_that_do_not_fit_are_refused(options: dict[str, Any], reason: str) -> None:
    with pytest.raises(ValueError, match=reason):
        ActorOptions(connect=["tcp/127.0.0.1:1"], **options).seatings(None)
