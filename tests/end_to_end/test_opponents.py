"""Test of `daedalus evaluate --against`: opponents of every kind, results for each side, and what is refused."""

import json
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import safetensors.numpy
from processes import Running
from saved_runs import CARTPOLE, save

import daedalus
from daedalus.cli.commands.evaluate import main
from daedalus.learner.league.versions import KeptVersion, VersionFolder
from daedalus.policy.saving.saved_policy import checkpoints, read_policy
from daedalus.protocol.spec import EnvironmentSpec

TIC_TAC_TOE = EnvironmentSpec(id="pettingzoo.classic.tictactoe_v3")
Start = Callable[..., Running]


class FirstLegal:
    """A bot that takes the first legal action."""

    def act(self, observation: Any, action_mask: Any) -> int:
        return int(np.flatnonzero(action_mask)[0])


class Illegal:
    """A bot that always takes the first action."""

    def act(self, observation: Any, action_mask: Any) -> int:
        return 0


@pytest.fixture
def evaluate(capsys: pytest.CaptureFixture[str]) -> Callable[..., tuple[int, str]]:
    """Function that runs the command in this process and returns its status, and its output or its error message."""

    def run(*words: object) -> tuple[int, str]:
        capsys.readouterr()
        status = main([*map(str, words)])
        captured = capsys.readouterr()
        return status, captured.err.strip() if status else captured.out

    return run


def keep_version(run: Path, policy_version: int) -> None:
    weights = safetensors.numpy.save(read_policy(checkpoints(run)[0]).weights)
    VersionFolder(run / "league").write(KeptVersion(policy_version, 0), weights)


def test_a_trained_policy_plays_a_kept_version(tmp_path: Path, start: Start) -> None:
    words = ("--actors", "1", "--env-steps", "2000", "--set", "evaluation.final_episodes=20", "--run-dir", "run")
    training = start("train", "--env", TIC_TAC_TOE.id, *words)
    assert training.wait() in (0, 3), training.output
    assert re.search(r"evaluation of the newest checkpoint, .* against random: won \d+ of 20 games", training.output)
    recorded = json.loads((tmp_path / "run" / "evaluation.json").read_text())
    assert recorded["matches"]["total"]["games"] == len(recorded["returns"]) == 20
    played = start("evaluate", "run", "--against", "v0", "--games", "20", "--actions", "sampled")
    assert played.wait() == 0, played.output
    sides = [line.split()[:2] for line in played.lines[-4:-1]]
    assert sides == [["player_1", "10"], ["player_2", "10"], ["all", "20"]]
    assert "Wilson's interval at 95 %" in played.lines[-1]


@pytest.mark.parametrize("opponent", ["random", "test_opponents:FirstLegal", "v7", "RUN2", "CHECKPOINT"])
def test_results_are_counted_for_each_side(
    tmp_path: Path, evaluate: Callable[..., tuple[int, str]], opponent: str
) -> None:
    run, other = save(tmp_path / "run", TIC_TAC_TOE, 9), save(tmp_path / "other", TIC_TAC_TOE, 3, 4, weights_seed=6)
    keep_version(run, 7)
    named = {"RUN2": str(other), "CHECKPOINT": str(checkpoints(other)[1])}.get(opponent, opponent)
    status, text = evaluate(run, "--against", named, "--games", 30, "--openings", 2, "--json", "--seed", 4)
    assert status == 0, text
    result = json.loads(text)
    matches = result["matches"]
    version = {"v7": 7, "RUN2": 4, "CHECKPOINT": 3}.get(opponent)
    assert (matches["opponent"], matches["opponent_version"], matches["openings"]) == (named, version, 2)
    assert (result["seed"], result["episodes"], result["policy_version"]) == (4, 30, 9)
    total, sides = matches["total"], matches["sides"]
    assert [side["agents"] for side in sides] == [["player_1"], ["player_2"]]
    assert [side["games"] for side in sides] == [15, 15]
    returns = np.array(result["returns"])
    for score, own in ((total, returns), (sides[0], returns[:15]), (sides[1], returns[15:])):
        assert score["wins"] == np.count_nonzero(own > 0)
        assert score["draws"] == np.count_nonzero(own == 0)
        assert score["losses"] == np.count_nonzero(own < 0)
        assert score["return_mean"] == pytest.approx(own.mean()) == -score["opponent_return_mean"]
        assert score["win_interval"][0] <= score["wins"] / score["games"] <= score["win_interval"][1]
    assert 2 < matches["distinct_games"] <= 30
    assert evaluate(run, "--against", named, "--games", 30, "--openings", 2, "--json", "--seed", 4) == (0, text)


def test_games_without_chance_are_said_to_be_equal(tmp_path: Path) -> None:
    run = save(tmp_path / "run", TIC_TAC_TOE, 9)
    result = daedalus.evaluate(run, against=run, actions="greedy", episodes=8)
    assert result.matches is not None
    assert result.matches.distinct_games == 2
    assert result.notes[0].startswith("only 2 of the 8 games differ")
    assert "--openings" in result.notes[0]


@pytest.mark.parametrize(
    ("words", "text"),
    [
        (("--against", "test_opponents:Illegal"), "opponent test_opponents:Illegal, as player_[12]: its action is 0"),
        (("--against", "test_opponents:Missing"), "--against=test_opponents:Missing: .* has no 'Missing'"),
        (("--against", "v8"), "the run has no such version any more; it keeps v7"),
        (("--against", "nowhere"), "--against nowhere: there is no such directory; name"),
        (("--against", "CARTPOLE"), "was trained on CartPole-v1 with .* both must have the same spaces"),
        (("--against", "random", "--games", "3"), "has 2 sides, .*: choose 2 or 4"),
        (("--against", "random", "--video", "a.gif"), "--video"),
        (("--openings", "2"), "--openings needs --against"),
    ],
)
def test_opponents_that_cannot_play_are_refused_in_one_line(
    tmp_path: Path, evaluate: Callable[..., tuple[int, str]], words: tuple[str, ...], text: str
) -> None:
    run = save(tmp_path / "run", TIC_TAC_TOE, 9)
    keep_version(run, 7)
    cartpole = save(tmp_path / "cartpole", CARTPOLE, 1) if "CARTPOLE" in words else tmp_path
    status, error = evaluate(run, *(str(cartpole) if word == "CARTPOLE" else word for word in words))
    assert status in (1, 2)
    (line,) = error.splitlines()
    assert re.search(text, line), line
