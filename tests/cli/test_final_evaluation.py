"""launch/final_evaluation.py: which episodes it plays and what it says of them; evaluators that end without a report.

The selection of the best checkpoint plays the training's backend, on episodes that nothing else plays.
"""

import subprocess
import sys
import threading
from pathlib import Path
from typing import Any

import pytest
from log_lines import LINES
from saved_runs import CARTPOLE, save, score

from daedalus.actor.evaluation.episodes import EvaluationStoppedError
from daedalus.launch.child_output import ChildOutput, Streams
from daedalus.launch.final_evaluation import FinalEpisodes, is_below_training, sampled_note
from daedalus.launch.local_run import LocalRun, RunFailedError
from daedalus.launch.local_training import evaluate_run
from daedalus.learner.run.run_directory import write_config, write_json
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


def result(mean: float, std: float, actions: str = "greedy", episodes: int = 100) -> dict[str, Any]:
    return {"return_mean": mean, "return_std": std, "actions": actions, "episodes": episodes}


@pytest.mark.parametrize(
    ("evaluation", "training_mean", "below"),
    [
        (result(0.0, 0.0), 0.9, True),
        (result(180.0, 100.0), 200.0, False),  # a standard error of 10
        (result(160.0, 100.0), 200.0, True),
        (result(160.0, 100.0, episodes=16), 200.0, False),
        (result(0.0, 0.0, episodes=9), 200.0, False),
        (result(250.0, 1.0), 200.0, False),
        (result(0.0, 0.0, "sampled"), 0.9, False),
        (result(0.0, 0.0), None, False),
    ],
)
def test_greedy_episodes_are_compared_with_training(
    evaluation: dict[str, Any], training_mean: float | None, below: bool
) -> None:
    assert is_below_training(evaluation, training_mean) == below


def test_sampled_actions_are_recommended_only_if_they_are_better() -> None:
    better = sampled_note(result(0.0, 0.0), result(0.9, 0.1, "sampled"))
    assert better.startswith("sampled actions: return 0.9 +- 0.1 over 100 episodes")
    assert better.endswith("--actions sampled (evaluation.actions)")
    assert "--actions" not in sampled_note(result(160.0, 100.0), result(170.0, 100.0, "sampled"))


@pytest.mark.parametrize(
    ("program", "how", "reason"),
    [
        ("import os; os._exit(0)", "failed with status 0", r"\(status 0\): play it with `daedalus check`"),
        ("import os; os._exit(7)", "failed with status 7", r"\(status 7\)"),
        ("import os; os.abort()", "was killed by signal 6", r"\(signal 6\)"),
        ("import os; os.kill(os.getpid(), 9)", "was killed by signal 9", "check whether it was for lack of memory"),
    ],
)
def test_an_evaluator_that_ends_without_a_report_is_named_each_time(
    tmp_path: Path, program: str, how: str, reason: str
) -> None:
    def start(module: str, *arguments: str, streams: Streams, one_thread: bool = False) -> subprocess.Popen[bytes]:
        command = [sys.executable, "-S", "-c", program]
        return subprocess.Popen(command, stdin=subprocess.PIPE, stdout=streams.stdout, stderr=streams.stderr)

    run = save(tmp_path / "run", CARTPOLE, 1)
    write_json(run / "summary.json", {})
    spec = read_policy(checkpoints(run)[0]).spec
    write_config(run, spec)
    local_run = LocalRun(directory=run, spec=spec, started=0.0, start_player=start)
    with (
        ChildOutput(tmp_path / "output.log", print, print) as output,
        pytest.raises(RunFailedError, match=reason),
    ):
        evaluate_run(local_run, threading.Event(), output)
    assert LINES == [f"evaluation-0 {how}; started again"] * 2
