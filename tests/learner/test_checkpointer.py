"""learner/training/checkpointer.py: each policy version is saved once for evaluations."""

import shutil
import threading
from pathlib import Path

import pytest
from building import POLICY, SPACES, make_rollouts, run_spec

from daedalus.learner.run import run_directory
from daedalus.learner.run.counters import check_counters
from daedalus.learner.run.run_state import RunState
from daedalus.learner.serving.events import EventLog
from daedalus.learner.training.checkpointer import Checkpointer
from daedalus.learner.training.learner import Learner
from daedalus.policy.saving.saved_policy import read_policy
from daedalus.protocol.epochs import new_epoch
from daedalus.protocol.spec import TrainingSpec


def written(directory: Path) -> int:
    """Return a number that changes with every writing of a checkpoint."""
    return (directory / "manifest.json").stat().st_ino


def test_a_version_is_saved_once_for_evaluations(tmp_path: Path) -> None:
    learner = Learner(TrainingSpec(), POLICY, SPACES)
    state = RunState(tmp_path, run_spec(), started=0.0)
    checkpointer = Checkpointer(state, learner, b"program", SPACES, events=EventLog(), lock=threading.Condition())
    first = checkpointer.ensure_saved()
    assert first is not None
    before = written(first)
    assert checkpointer.ensure_saved() == first
    assert written(first) == before
    learner.step(make_rollouts(1), 0.0)
    second = checkpointer.ensure_saved()
    assert second is not None
    assert read_policy(second).policy_version == 1
    shutil.rmtree(second)
    assert checkpointer.ensure_saved() == second
    assert second.is_dir()


def test_a_version_whose_saving_failed_is_saved_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    events, state = EventLog(), RunState(tmp_path, run_spec(), started=0.0)
    learner, health = Learner(TrainingSpec(), POLICY, SPACES), state.health
    checkpointer = Checkpointer(state, learner, b"program", SPACES, events=events, lock=threading.Condition())
    (tmp_path / "checkpoints").write_text("in the way")
    assert checkpointer.ensure_saved() is None
    assert health.save_fault
    (tmp_path / "checkpoints").unlink()
    assert checkpointer.ensure_saved() is not None
    assert not health.save_fault


def test_a_run_whose_directory_was_removed_can_be_resumed(tmp_path: Path) -> None:
    directory = tmp_path / "run"
    run_directory.create(directory, run_spec())
    events, state = EventLog(), RunState(directory, run_spec(), started=0.0)
    learner = Learner(TrainingSpec(), POLICY, SPACES)
    checkpointer = Checkpointer(state, learner, b"program", SPACES, events=events, lock=threading.Condition())
    checkpointer.save()
    shutil.rmtree(directory)
    saved = checkpointer.save()
    assert saved is not None
    assert run_directory.read_config(directory) == run_spec()
    texts = [event.text for event in events.report()]
    assert any("was moved or removed: the run continues in a new one" in text for text in texts)
    checkpointer.save()
    assert sum("moved or removed" in event.text for event in events.report()) == 1


def test_a_learner_that_resumes_is_newer_than_every_learner_before_its_checkpoint(tmp_path: Path) -> None:
    first = RunState(tmp_path, run_spec(), started=0.0)
    saved = check_counters(first.saved(now=1.0))
    copies = [RunState(tmp_path, run_spec(), 0.0, starts_before=saved["starts"]) for _ in range(20)]
    assert all(first.learner_epoch < copy.learner_epoch < 2**62 for copy in copies)
    assert len({copy.learner_epoch for copy in copies}) == len(copies)
    after = RunState(tmp_path, run_spec(), 0.0, starts_before=check_counters(copies[0].saved(now=1.0))["starts"])
    assert after.learner_epoch > max(copy.learner_epoch for copy in copies)
    assert new_epoch(10**9) < 2**62
