"""learner/run/resuming.py: whether a run has anything left to train."""

from pathlib import Path
from typing import Any

import pytest
from building import run_spec

from daedalus.learner.run.counters import RunCounters
from daedalus.learner.run.resuming import FinishedRun, finished_run
from daedalus.learner.run.run_directory import write_json
from daedalus.policy.saving.sealed import write_sealed

TARGET = {"target_return": 10.0, "target_episodes": 3}


@pytest.fixture
def run(tmp_path: Path) -> Path:
    """A run that was trained for 5000 env_steps, with a mean return of 12 over the newest episodes."""
    counters = RunCounters(3)
    counters.env_steps = 5000
    counters.returns.extend([11.0, 12.0, 13.0])
    write_sealed(tmp_path / "checkpoints" / "0000000007", {}, {"counters": counters.state(60.0)})
    return tmp_path


def finished(run: Path, summary: dict[str, Any] | None, **training: Any) -> FinishedRun | None:
    if summary is not None:
        write_json(run / "summary.json", {"env_steps": 5000, "finished": True, "solved": True, **summary})
    return finished_run(run, run_spec(**training))


def test_a_run_at_its_budget_has_nothing_to_train(run: Path) -> None:
    end = finished(run, {"evaluation": {}}, env_steps=5000)
    assert end is not None
    assert end.reason == "5,000 env_steps are done, and the budget is 5,000: raise it with --env-steps"
    assert (end.missed, end.to_evaluate) == (False, False)
    assert finished(run, {}, env_steps=5001) is None
    smaller = finished(run, {"finished": False}, env_steps=20)  # it was stopped
    assert smaller is not None
    assert "the budget is 20:" in smaller.reason
    assert not smaller.to_evaluate


def test_a_run_that_reached_its_target_has_nothing_to_train(run: Path) -> None:
    end = finished(run, {}, **TARGET)
    assert end is not None
    assert end.reason.startswith("the target return 10 was reached, and 5,000 env_steps are done: train on with --set")
    assert (end.missed, end.to_evaluate) == (False, True)
    assert finished(run, {}, **TARGET, stop_when_solved=False) is None
    assert finished(run, {}, **{**TARGET, "target_return": 99.0}) is None
    missed = finished(run, {}, **{**TARGET, "target_return": 99.0}, env_steps=5000)
    assert missed is not None
    assert missed.missed


def test_a_run_that_was_stopped_before_new_episodes_confirmed_its_target_has_to_train(run: Path) -> None:
    assert finished(run, {"finished": False, "solved": False}, **TARGET) is None


def test_a_run_that_an_evaluation_solved_has_nothing_to_train(run: Path) -> None:
    counters = RunCounters(3)
    counters.env_steps = 5000
    counters.evaluated(99.0)
    write_sealed(run / "checkpoints" / "0000000008", {}, {"counters": counters.state(60.0)})
    target = {**TARGET, "target_return": 99.0}
    for budget in (5000, 9000):
        end = finished(run, {}, **target, algorithm="one_step_q", env_steps=budget)
        assert end is not None
        assert end.reason.startswith("the target return 99 was reached")
        assert not end.missed
    assert finished(run, {}, **target, env_steps=9000) is None  # actors that do not explore


def test_a_learner_that_was_killed_before_its_summary_is_started_again(run: Path) -> None:
    assert finished(run, None, env_steps=5000) is None
    assert finished(run, {"env_steps": 4000}, env_steps=5000) is None  # of an earlier end
    assert finished(run / "nowhere", None) is None


def test_a_damaged_checkpoint_is_skipped(run: Path) -> None:
    write_sealed(run / "checkpoints" / "0000000008", {}, {"counters": {"env_steps": "many"}})
    (run / "checkpoints" / "0000000009").mkdir()
    assert finished(run, {}, env_steps=5000) is not None
