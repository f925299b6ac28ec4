"""A target that is reached has to be confirmed by new episodes, with real processes."""

import json
import os
import shutil
import signal
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

import pytest
from certificates import make_certificates
from lucky_environment import BUSY, UNLUCKY, WAITING
from processes import Running, free_address, processes_mentioning, until

from daedalus.learner.serving.events import read_events

Start = Callable[..., Running]
# Not in processes of their own, as on a busy machine: environments know an evaluation by the process's command.
SIZES = (
    "environment.processes=false",
    "collection.actors=1",
    "collection.envs_per_actor=2",
    "collection.rollout_length=8",
    "training.minibatches=1",
)
TARGET = ("training.target_return=1", "training.target_episodes=10", "evaluation.final_episodes=0")
WORDS = [word for each in (*SIZES, *TARGET) for word in ("--set", each)]


@pytest.fixture
def train(start: Start, tmp_path: Path) -> Callable[..., Running]:
    """Function that trains in an environment whose evaluations are as bad as files in `tmp_path` say."""
    shutil.copy(Path(__file__).parent.parent / "lucky_environment.py", tmp_path)
    return lambda *more: start("train", "--env", "lucky_environment:Lucky-v0", "--run-dir", "run", *WORDS, *more)


def summary(folder: Path) -> dict[str, Any]:
    return json.loads((folder / "run" / "summary.json").read_text())


def players(folder: Path) -> list[int]:
    """Return the ids of the evaluators of the run in `folder`."""
    found = []
    for pid in processes_mentioning("--evaluator"):
        with suppress(FileNotFoundError):  # it has ended meanwhile
            found += [pid] if Path(f"/proc/{pid}/cwd").readlink() == folder else []
    return found


NOT_YET = "not there yet: the new episodes have a mean return of 0. That is normal"


def test_training_continues_until_new_episodes_confirm_the_target(start: Start, tmp_path: Path) -> None:
    """Also without a launcher: the learner is alone with what actors report, and its evaluator has no certificate."""
    shutil.copy(Path(__file__).parent.parent / "lucky_environment.py", tmp_path)
    (tmp_path / UNLUCKY).touch()
    certificates, address = make_certificates(tmp_path / "certs"), free_address().replace("tcp/", "tls/")
    start("router", "--listen", address, "--tls", certificates / "router")
    connect = ("--connect", address, "--tls")
    words = (*connect, certificates / "learner", "--run-dir", "run", *WORDS)
    learner = start("learner", "--env", "lucky_environment:Lucky-v0", *words)
    start("actor", *connect, certificates / "actor-arm", "--allow-module", "lucky_environment")
    learner.expect(NOT_YET)
    assert learner.wait() == 0, learner.output
    asked, refused, confirmed = (each.text for each in read_events(tmp_path / "run") if each.kind == "target")
    assert asked == confirmed
    assert asked.startswith("target 1 reached: ")
    assert refused.startswith(NOT_YET)
    told = [line for line in learner.lines if line.endswith(asked) or NOT_YET in line]
    assert [NOT_YET in line for line in told] == [False, True, False], learner.output
    result = summary(tmp_path)
    assert (result["solved"], result["finished"], result["confirmation_return_mean"]) == (True, True, 1.0)
    confirmation = result["confirmation"]
    assert (confirmation["confirmed"], confirmation["actions"], confirmation["episodes"]) == (True, "sampled", 10)
    assert confirmation["policy_version"] == result["updates"]  # the last one, at which training stopped
    assert result["episodes"] >= 20  # as many new training episodes as the target asks for, before the second attempt


def test_run_ends_at_its_target_if_the_episodes_cannot_be_played(train: Callable[..., Running], tmp_path: Path) -> None:
    (tmp_path / BUSY).touch()
    running = train("--set", "evaluation.final_episodes=1")
    assert running.wait() == 0, running.output
    reason = running.expect("the target cannot be confirmed: (.+)").group(1)
    assert "all 1 ports are in use" in reason
    result = summary(tmp_path)
    assert (result["solved"], result["finished"], "confirmation" in result) == (True, True, False)
    assert result["evaluation_return_mean"] == 1.0  # played after the actors have left
    assert reason in [each.text for each in read_events(tmp_path / "run") if each.kind == "target"][-1]


def test_evaluator_and_learner_that_are_killed_play_and_ask_again_and_a_run_that_is_stopped_is_not_solved(
    train: Callable[..., Running], start: Start, tmp_path: Path
) -> None:
    (tmp_path / WAITING).touch()
    running = train()
    running.expect("target 1 reached: ")
    address = running.expect(r"at (unixsock-stream/\S+);").group(1)
    until(lambda: players(tmp_path))
    (victim,) = players(tmp_path)
    os.kill(victim, signal.SIGKILL)
    running.expect("confirmation was killed by signal 9; started again")
    until(lambda: set(players(tmp_path)) - {victim})
    assert running.output.count("target 1 reached: ") == 1
    (orphan,) = players(tmp_path)
    (victim,) = set(processes_mentioning("commands.learner")) & set(processes_mentioning(address))
    os.kill(victim, signal.SIGKILL)
    until(lambda: running.output.count("target 1 reached: ") == 2)
    until(lambda: orphan not in players(tmp_path))
    until(lambda: players(tmp_path))
    running.process.terminate()
    assert running.wait() == 1, running.output
    stopped = summary(tmp_path)
    assert (stopped["solved"], stopped["finished"], "confirmation" in stopped) == (False, False, False)
    (tmp_path / WAITING).unlink()
    resumed = start("resume", "run", "--allow-module", "lucky_environment")
    assert resumed.wait() == 0, resumed.output
    resumed.expect("confirmation: return 1 over 10 new sampled episodes of the policy at that moment")
    result = summary(tmp_path)
    assert result["episodes"] < stopped["episodes"] + 10  # it asks again before it has played as many new episodes
    assert (result["solved"], result["confirmation_return_mean"]) == (True, 1.0)
    assert result["confirmation"]["policy_version"] == result["updates"]
