"""Test of the command line of `daedalus sweep`."""

import sys
from pathlib import Path

import pytest

from daedalus.cli.commands import sweep as command
from daedalus.cli.commands.sweep import sweep
from daedalus.learner.run.run_lock import RunLock

OVER = ("--over", "collection.rollout_length=5,20")


@pytest.fixture(autouse=True)
def _nothing_is_trained(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(command, "checked_spaces", lambda *_words, **_options: None)
    monkeypatch.setattr(command, "_run", lambda *_words: pytest.fail("it was started"))
    monkeypatch.setattr(command.signal, "signal", lambda *_words: None)


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["cartpol", *OVER], "unknown preset 'cartpol': did you mean cartpole"),
        ([*OVER], "name a preset"),
        (["cartpole", "--over", "collection.rollout_length=5,zwanzig"], "setting collection.rollout_length"),
        (["cartpole", "--over", "collection.rolout_length=5"], "unknown setting collection.rolout_length"),
        (["cartpole", *OVER, *OVER], "--over collection.rollout_length is there twice"),
        (
            ["cartpole", *OVER, "--set", "collection.rollout_length=7"],
            "collection.rollout_length is varied and also set",
        ),
        (
            ["cartpole", "--algorithm", "a2c", "--over", "training.algorithm=a3c"],
            "training.algorithm is varied and also",
        ),
        (["cartpole", "--over", "training.learning_rate=1e-4..1e-2"], "--over training.learning_rate: a range needs"),
        (["cartpole", *OVER, "--trials", "3"], "--trials is for --sampler"),
        (["cartpole", "--sampler"], "--sampler needs a setting to choose"),
    ],
)
def test_bad_input_is_one_line(words: list[str], message: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert sweep(words) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith(f"daedalus sweep: {message}")
    assert not Path("sweeps").exists()


def test_the_sampler_names_its_extra(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setitem(sys.modules, "optuna", None)
    assert sweep(["cartpole", *OVER, "--sampler"]) == 2
    assert capsys.readouterr().err == (
        'daedalus sweep: --sampler needs Optuna, which is not installed: pip install "daedalus-rl[analysis]"\n'
    )


def test_two_sweeps_do_not_share_a_folder(capsys: pytest.CaptureFixture[str]) -> None:
    folder = Path("sweeps/cartpole-rollout_length")
    folder.mkdir(parents=True)
    with RunLock(folder):
        assert sweep(["cartpole", *OVER]) == 1
    assert capsys.readouterr().err == (
        f"daedalus sweep: {folder} is in use by another sweep: stop it first, or choose another --folder\n"
    )


def test_the_folder_and_the_seeds_follow_from_the_command(monkeypatch: pytest.MonkeyPatch) -> None:
    seen = []
    monkeypatch.setattr(command, "_run", lambda search, folder, *_: seen.append((search, folder)) or 0)
    assert sweep(["cartpole", *OVER, "--algorithm", "a2c", "--seeds", "3", "--seed", "10"]) == 0
    (search, folder) = seen[0]
    assert folder == Path("sweeps/cartpole-a2c-rollout_length")
    assert "collection.rollout_length=5,20" in (folder / "sweep.toml").read_text()
    assert [run.seed for run in search.planned] == [10, 10, 11, 11, 12, 12]
    assert {run.spec.training.algorithm for run in search.planned} == {"a2c"}


def test_what_the_sweep_varies_may_be_what_another_setting_needs(monkeypatch: pytest.MonkeyPatch) -> None:
    """Or the environment: an argument of its constructor without a default."""
    seen = []
    monkeypatch.setattr(command, "_run", lambda search, *_: seen.extend(search.planned) or 0)
    lesson = ("--set", "environment.parameters.low=-0.05", "--set", "lessons.low.steps=[-0.01]")
    assert sweep(["cartpole", *lesson, "--over", "lessons.low.above=100,200", "--seeds", "1"]) == 0
    assert [run.spec.lessons["low"].above for run in seen] == [100, 200]
