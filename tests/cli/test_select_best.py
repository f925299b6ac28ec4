"""The selection of the best checkpoint plays the training's backend, on episodes that nothing else plays."""

import threading
from pathlib import Path

import pytest
from saved_runs import CARTPOLE, save, score

from daedalus.actor.evaluation.episodes import EvaluationStoppedError
from daedalus.launch.final_evaluation import FinalEpisodes
from daedalus.learner.run.run_directory import write_json
from daedalus.learner.serving.evaluator_host import EpisodePlan, EvaluatorHost
from daedalus.policy.saving.saved_policy import checkpoints, read_policy
from daedalus.transport.memory import MemoryNetwork, MemoryTransport


def test_selection_plays_on_the_backend_of_the_training_episodes_that_nothing_else_plays(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The final score is measured on another backend: selecting by it would make it the best of several."""
    run = save(tmp_path / "run", CARTPOLE, 1, 2, evaluation={"final_episodes": 20, "final_backend": "envpool"})
    score(run, 300.0, 1)
    write_json(run / "summary.json", {})
    plans: list[EpisodePlan] = []
    monkeypatch.setattr(EvaluatorHost, "play", lambda _self, plan, *_: plans.append(plan))
    spec, transport = read_policy(checkpoints(run)[0]).spec, MemoryTransport(MemoryNetwork())
    with pytest.raises(EvaluationStoppedError):
        FinalEpisodes(run, spec, transport, threading.Event()).evaluate()
    (plan,) = plans
    assert (plan.environment.backend, plan.episodes, plan.actions) == ("gymnasium", 20, "greedy")
    assert plan.seed not in (1, 1 + 2**32, 1 + 2**34)  # of the run, of the final evaluation, of the confirmation


def test_default_seed_of_an_evaluation_is_apart_from_that_of_its_run(tmp_path: Path) -> None:
    from daedalus.cli.commands.evaluate import main

    run = save(tmp_path / "run", CARTPOLE.model_copy(update={"max_episode_steps": 2}), 1)
    output = tmp_path / "result.json"
    with output.open("w") as file, pytest.MonkeyPatch.context() as patched:
        patched.setattr("sys.stdout", file)
        assert main([str(run), "--json", "--episodes", "1"]) == 0
    assert '"seed": 4294967297' in output.read_text()
