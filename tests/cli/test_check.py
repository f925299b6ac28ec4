"""`daedalus check`: the report of an environment."""

import re
from pathlib import Path

import pytest

from daedalus.cli.commands import check as command
from daedalus.cli.commands.check import check

ENV = ["--env", "faulty_environments:Faulty-v0", "--seconds", "0.05"]
LONGER = ["--seconds", "1"]  # enough for several steps on a busy machine
PATH, PARAMETER = "lesson_environment:PathWithMethod", ["--set", "environment.parameters.stones=7"]


@pytest.fixture(autouse=True)
def _beside_the_module(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(Path(__file__).parent.parent)


def test_a_good_environment_and_what_train_would_choose(capsys: pytest.CaptureFixture[str]) -> None:
    assert check([*ENV, *LONGER, "--algorithm", "a2c"]) == 0
    lines = dict(line.split(maxsplit=1) for line in capsys.readouterr().out.splitlines() if "note" not in line)
    assert lines["environment"] == "faulty_environments:Faulty-v0 of gymnasium"
    assert lines["spaces"] == "observation: float32 array of shape (2,); action: 2 choices"
    assert "ended, after 10 to 10 env_steps; return 10.0 to 10.0, mean 10.0" in lines["episodes"]
    assert "ms a step" in lines["speed"]
    assert lines["train"].startswith("a2c, 2 actors x 8 environments, rollouts of 16 rows, 1,000,000 env_steps")
    assert lines["network"] == "encoder mlp, 8,907 parameters"
    assert lines["result"] == "no problem found"


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (
            [*LONGER, "--set", "environment.kwargs.fault=reward"],
            "problem       environment .* the reward nan: it must be fini",
        ),
        (["--set", "policy.encoder=nature"], "problem       the encoder 'nature' takes images"),
        (
            [
                "--env",
                "lesson_environment:PathWithMethod",
                *LONGER,
                *PARAMETER,
                "--set",
                "lessons.stones.between=[1,200]",
            ],
            r"problem       .*: set_parameters\(stones=200\) raises .* change lessons.stones",
        ),
        (
            [*("--algorithm", "own_losses:Weighted", "--set", "training.algorithm_kwargs.wieght=1")],
            "problem       training.algorithm=own_losses:Weighted: .* unexpected keyword argument 'wieght'",
        ),
        (
            ["--set", "environment.kwargs.fault=crash"],
            r"problem       .*Faulty-v0 ended its process \(status 7\), as it",
        ),
        (["--set", "environment.kwargs.fault=exit"], "problem       .*Faulty-v0: step raises SystemExit: 0 "),
    ],
)
def test_a_problem_is_the_exit_status(words: list[str], message: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert check([*ENV, *words]) == 1
    output = capsys.readouterr().out
    assert any(re.match(message, line) for line in output.splitlines()), output


def test_an_environment_that_hangs_is_a_problem(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(command, "_MORE_SECONDS", 0.45)
    assert check([*ENV, "--set", "environment.kwargs.fault=hang"]) == 1
    assert "Faulty-v0: the check was not done within 0.5 s: a call does not return" in capsys.readouterr().out


def test_an_unknown_environment_with_the_name_of_a_preset(capsys: pytest.CaptureFixture[str]) -> None:
    assert check(["--env", "cartpole"]) == 1
    output = capsys.readouterr().out
    assert "; 'cartpole' is a preset, which is named without --env" in output
    assert "\ntrain " not in output  # the settings depend on the environment


def test_warnings_do_not_change_the_exit_status(capsys: pytest.CaptureFixture[str]) -> None:
    assert check([*ENV, "--set", "environment.kwargs.fault=bounds"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert sum(line.startswith("warning       environment") for line in lines) == 2
    assert lines[-1] == "result        can be trained on, with 2 warnings"


@pytest.mark.parametrize("words", [["--env", "A", "--set", "environment.id=B"], ["cartpole", "--seconds", "0"]])
def test_bad_usage_is_one_line(words: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    assert check(words) == 2
    assert capsys.readouterr().err.count("\n") == 1
