"""launch/local_training.py: that no process of a run outlives it, and which episodes are played at its end."""

import subprocess
import sys
import threading
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from saved_runs import CARTPOLE, save

from daedalus.cli.commands import train as train_command
from daedalus.launch import local_training, run_choice
from daedalus.launch.child_output import ChildOutput
from daedalus.launch.final_evaluation import FinalEpisodes
from daedalus.launch.local_run import LocalRun, RunFailedError
from daedalus.launch.local_training import run_locally
from daedalus.launch.logs import LogOptions
from daedalus.launch.supervision import Supervised
from daedalus.launch.tracker_processes import TrackerProcesses
from daedalus.learner.serving.evaluator_host import EpisodePlan, EvaluatorHost
from daedalus.protocol.messages import EvaluationReport
from daedalus.protocol.spec import RunSpec
from daedalus.transport.memory import MemoryNetwork, MemoryTransport


def test_actor_that_cannot_be_started_ends_the_learner_and_the_actors_before_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    started: list[subprocess.Popen[bytes]] = []

    def begin(_first: bool) -> subprocess.Popen[bytes]:
        if len(started) == 3:
            raise BlockingIOError(11, "Resource temporarily unavailable")  # too many processes
        started.append(subprocess.Popen([sys.executable, "-S", "-c", "input()"], stdin=subprocess.PIPE))
        return started[-1]

    def supervised(*_: Any) -> Supervised:
        return Supervised("process", begin, ended={0})

    monkeypatch.setattr(local_training, "supervised_learner", supervised)
    monkeypatch.setattr(local_training, "supervised_actor", supervised)
    spec = RunSpec.model_validate({"environment": {"id": "CartPole-v1"}, "collection": {"actors": 4}})
    output = ChildOutput(tmp_path / "output.log", print, print)
    try:
        with pytest.raises(BlockingIOError):
            run_locally(LocalRun(directory=tmp_path, spec=spec, started=0.0), threading.Event(), output)
        assert [process.poll() is not None for process in started] == [True] * 3
    finally:
        for process in started:
            process.kill()
            process.wait()


def test_trackers_have_little_time_after_an_interrupt(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    stopping, seen = threading.Event(), []

    def interrupted(*_: Any) -> int:
        raise KeyboardInterrupt

    monkeypatch.setattr(local_training, "train", interrupted)
    monkeypatch.setattr(TrackerProcesses, "finish", lambda _, stop: seen.append(stop.is_set()))
    run = LocalRun(directory=tmp_path, spec=RunSpec.model_validate({"environment": {"id": "X-v0"}}), started=0.0)
    with pytest.raises(KeyboardInterrupt):
        run_locally(run, stopping, ChildOutput(tmp_path / "output.log", print, print))
    assert seen == [True]


@pytest.mark.parametrize("reason", ["all actors failed: joint 3 is stuck", ""], ids=["a reason", "printed by a child"])
def test_a_run_that_failed_after_a_checkpoint_says_how_to_continue_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], reason: str
) -> None:
    directory = tmp_path / "run"

    def fail(*_: Any) -> None:
        (directory / "checkpoints" / "0000000001").mkdir(parents=True)
        raise RunFailedError(reason)

    monkeypatch.setattr(train_command, "run_locally", fail)
    monkeypatch.setattr(run_choice, "checked_spaces", lambda *_, **_others: None)
    monkeypatch.setattr(LogOptions, "configure", lambda *_, **_others: None)
    monkeypatch.setattr(train_command, "stop_on_signals", lambda **_: threading.Event())
    monkeypatch.setattr(train_command.signal, "signal", lambda *_: None)
    assert train_command.train(["cartpole", "--run-dir", str(directory)]) == 1
    assert capsys.readouterr().err.splitlines() == [
        *([f"daedalus train: {reason}"] if reason else []),
        f"when that is corrected, continue with: daedalus resume {directory}",
    ]


@pytest.mark.parametrize(("algorithm", "played"), [("impala", ["greedy", "sampled"]), ("n_step_q", ["greedy"])])
def test_sampled_episodes_are_played_only_if_sampled_actions_can_differ(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, algorithm: str, played: list[str]
) -> None:
    """The greedy episodes are worse than training was. The policy of action values is greedy in both."""
    actions: list[str] = []

    def play(_host: EvaluatorHost, plan: EpisodePlan, *_: object) -> list[EvaluationReport]:
        actions.append(plan.actions)
        returns, lengths = np.ones(100), np.ones(100, np.int32)
        report = EvaluationReport(evaluator="e", learner_epoch=1, policy_version=1, returns=returns, lengths=lengths)
        return [report]

    monkeypatch.setattr(EvaluatorHost, "play", play)
    save(tmp_path, CARTPOLE, 1, training={"algorithm": algorithm})
    (tmp_path / "summary.json").write_text('{"solved": false, "episode_return_mean": 9.0}')
    spec = RunSpec.model_validate({"environment": CARTPOLE, "training": {"algorithm": algorithm}})
    FinalEpisodes(tmp_path, spec, MemoryTransport(MemoryNetwork()), threading.Event()).evaluate()
    assert actions == played
