"""The selection of the best checkpoint plays the training's backend, on episodes that nothing else plays."""

import threading
from pathlib import Path
from typing import Any

import pytest
from saved_runs import CARTPOLE, save, score

from daedalus.cli.commands.evaluate import parser
from daedalus.launch import final_evaluation as module
from daedalus.launch.child_output import ChildOutput
from daedalus.launch.final_evaluation import select_best
from daedalus.policy.saving.saved_policy import checkpoints, read_policy


@pytest.fixture
def played(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> list[Any]:
    """The arguments of the evaluations that the selection among two checkpoints starts."""
    run = save(tmp_path / "run", CARTPOLE, 1, 2, evaluation={"final_episodes": 20, "final_backend": "envpool"})
    score(run, 300.0, 1)
    started: list[Any] = []

    def play(commands: list[list[str]], *_: object) -> list[dict[str, float]]:
        started.extend(parser().parse_args(command) for command in commands)
        return [{"return_mean": 1.0, "return_std": 0.0} for _ in commands]

    monkeypatch.setattr(module, "play", play)
    with ChildOutput(tmp_path / "output.log", lambda _: None, lambda _: None) as output:
        select_best(run, read_policy(checkpoints(run)[0]).spec, ["--episodes", "20"], threading.Event(), output)
    assert len(started) == 2
    return started


def test_selection_plays_on_the_backend_of_the_training(played: list[Any]) -> None:
    """The final score is measured on another: selecting by it would make it the best of several."""
    assert {arguments.backend for arguments in played} == {"gymnasium"}


def test_selection_does_not_play_the_episodes_of_the_final_evaluation_or_of_training(played: list[Any]) -> None:
    (seed,) = {arguments.seed for arguments in played}
    assert seed not in (1, 1 + 2**32)  # of the run; of the final evaluation, which is the default of the command


def test_default_seed_of_an_evaluation_is_apart_from_that_of_its_run(tmp_path: Path) -> None:
    from daedalus.cli.commands.evaluate import main

    run = save(tmp_path / "run", CARTPOLE.model_copy(update={"max_episode_steps": 2}), 1)
    output = tmp_path / "result.json"
    with output.open("w") as file, pytest.MonkeyPatch.context() as patched:
        patched.setattr("sys.stdout", file)
        assert main([str(run), "--json", "--episodes", "1"]) == 0
    assert '"seed": 4294967297' in output.read_text()
