"""The end of a run and of a learner, as actors of every speed see it: learner and actors over the memory transport."""

import errno
import os
import re
import threading
from pathlib import Path
from typing import Any

import pytest
from log_lines import LINES
from processes import LIMIT, until
from session_fleet import GatedActor, LearnerProcess, order_to

from daedalus.actor.evaluation.evaluator import Evaluator
from daedalus.actor.session.actor_config import ActorConfig
from daedalus.learner.reporting import recorder
from daedalus.learner.reporting.run_reporter import RunReporter
from daedalus.learner.run import heartbeat
from daedalus.learner.serving import actor_server, received_orders, run_context
from daedalus.learner.training import checkpointer
from daedalus.learner.training.checkpoint import load_newest
from daedalus.policy.saving.saved_policy import checkpoints
from daedalus.protocol import keys
from daedalus.protocol.codec import decode
from daedalus.protocol.limits import Limits
from daedalus.protocol.messages import Acknowledgement, Refusal, RunStatus, StatusReport
from daedalus.transport.memory import MemoryNetwork, MemoryTransport

ACTORS = 15


def fleet_inside_rollouts(network: MemoryNetwork) -> list[GatedActor]:
    """Return actors that have all begun a rollout, and whose gates are closed."""
    actors = [GatedActor(network, f"actor-{index}") for index in range(ACTORS)]
    for actor in actors:
        actor.await_rollout()
    return actors


def count(start: str) -> int:
    return sum(line.startswith(start) for line in LINES)


def test_end_of_the_run_reaches_actors_whose_rollouts_outlive_the_learner(
    network: MemoryNetwork, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(actor_server, "_LEAVE_SECONDS", 0.0)
    learner = LearnerProcess(network, tmp_path / "run", env_steps=1)
    actors = fleet_inside_rollouts(network)
    actors[0].open_gate()  # its rollout ends the run
    assert learner.join().finished
    for actor in actors:
        actor.open_gate()
    assert [actor.join() for actor in actors] == [True] * ACTORS
    assert count("run 'run': the run is over") == ACTORS
    assert count("joined run") == ACTORS


def test_learner_answers_that_the_run_is_over_until_all_actors_have_left(
    network: MemoryNetwork, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(actor_server, "_LEAVE_SECONDS", 1e6)
    learner = LearnerProcess(network, tmp_path / "run", env_steps=1)
    actors = fleet_inside_rollouts(network)
    actors[0].open_gate()
    assert actors[0].join()
    late = GatedActor(network, "late")
    assert late.join()  # it is answered that the run is over
    assert not learner.ended
    for actor in actors[1:]:
        actor.open_gate()
        assert actor.join()
    assert learner.join().finished


def test_stop_ends_the_wait_for_actors(network: MemoryNetwork, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(actor_server, "_LEAVE_SECONDS", 1e6)
    learner = LearnerProcess(network, tmp_path / "run", env_steps=1)
    actors = fleet_inside_rollouts(network)
    actors[0].open_gate()
    assert actors[0].join()
    learner.stop.set()
    assert learner.join().finished
    for actor in actors:
        actor.stop.set()
        actor.open_gate()
        actor.join()


def test_actors_wait_for_a_learner_that_was_stopped_and_join_it_again(network: MemoryNetwork, tmp_path: Path) -> None:
    stopped = LearnerProcess(network, tmp_path / "run")
    actors = fleet_inside_rollouts(network)
    for actor in actors[::2]:
        actor.open_gate()
    until(lambda: count("joined run") == ACTORS)
    stopped.stop.set()
    outcome = stopped.join()
    assert (outcome.finished, outcome.saved) == (False, True)
    assert count("stopped; checkpoint saved at ") == 1
    for actor in actors:
        actor.open_gate()
    until(lambda: count("run 'run': the learner was stopped; waiting for it to return") == ACTORS)
    assert not any(actor.ended for actor in actors)
    resumed = LearnerProcess(network, tmp_path / "run", resume=True)
    until(lambda: count("joined run") == 2 * ACTORS)
    resumed.stop.set()
    resumed.join()
    for actor in actors:
        actor.stop.set()
        assert actor.join() is False


def test_last_checkpoint_is_saved_although_the_last_metrics_fail(
    network: MemoryNetwork, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(actor_server, "_LEAVE_SECONDS", 0.0)

    def fail(*_: object, last: bool) -> None:
        raise ZeroDivisionError("a bug in a diagnostic of the user's algorithm")

    monkeypatch.setattr(RunReporter, "row", fail)
    learner = LearnerProcess(network, tmp_path / "run", env_steps=1)
    actor = GatedActor(network, "actor")
    actor.open_gate()
    assert actor.join()
    until(lambda: learner.ended)
    assert isinstance(learner.error, ZeroDivisionError)
    newest = load_newest(tmp_path / "run")
    assert newest is not None
    assert newest.counters["env_steps"] >= 1


@pytest.mark.parametrize(
    ("fault", "advice"), [(errno.ENOSPC, "make room"), (errno.EDQUOT, "make room"), (errno.EACCES, "correct this")]
)
def test_error_of_the_last_checkpoint_is_logged_and_promises_no_other_attempt(
    network: MemoryNetwork, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, fault: int, advice: str
) -> None:
    def fail(*_: object, **_others: object) -> None:
        raise OSError(fault, os.strerror(fault))

    monkeypatch.setattr(actor_server, "_LEAVE_SECONDS", 0.0)
    monkeypatch.setattr(checkpointer, "save_checkpoint", fail)
    learner = LearnerProcess(network, tmp_path / "run", env_steps=1)
    actor = GatedActor(network, "actor")
    actor.open_gate()
    outcome = learner.join()
    assert (outcome.finished, outcome.saved) == (True, False)
    (error,) = (line for line in LINES if "the last checkpoint" in line)
    assert re.fullmatch(
        rf"the last checkpoint, at \d+ env_steps, could not be saved: {os.strerror(fault)}; "
        f"{advice}, then resume the run",
        error,
    )
    assert actor.join()


def test_training_goes_on_and_a_learner_ends_while_its_disk_does_not_answer(
    network: MemoryNetwork, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Every call that waits for the disk hangs from some moment on, as on a network's file system that is gone."""
    gone, back = threading.Event(), threading.Event()

    def hanging(name: str) -> None:
        function = getattr(os, name)

        def hang(*arguments: Any, **options: Any) -> Any:
            if gone.is_set() and threading.current_thread().name in learners_threads:
                assert back.wait(LIMIT)
            return function(*arguments, **options)

        monkeypatch.setattr(os, name, hang)

    learner = LearnerProcess(network, tmp_path / "run")
    learners_threads = {learner.name, "checkpoints", "recorder", "heartbeat"}
    for name in ("fsync", "pwrite", "open", "replace"):
        hanging(name)
    monkeypatch.setattr(checkpointer, "STOP_SECONDS", 0.1)
    monkeypatch.setattr(recorder, "_CLOSE_SECONDS", 0.1)
    monkeypatch.setattr(heartbeat, "_END_SECONDS", 0.1)
    monkeypatch.setattr(run_context, "SLOW_DISK_SECONDS", 0.0)
    monkeypatch.setattr(received_orders, "_ANSWER_SECONDS", 0.05)  # none comes: the test need not wait
    operator = MemoryTransport(network)

    def order() -> Acknowledgement:
        answer = order_to(network, "checkpoint")
        assert isinstance(answer, Acknowledgement)
        return answer

    def status() -> RunStatus:
        report = decode(operator.query(keys.status("run"), timeout=LIMIT)[0], Limits())
        assert isinstance(report, StatusReport)
        return report.status

    try:
        actor = GatedActor(network, "actor")
        actor.open_gate()
        until(lambda: count("joined run") == 1)
        order()
        until(lambda: checkpoints(tmp_path / "run"))
        saved = checkpoints(tmp_path / "run")
        gone.set()
        assert order().reason.startswith("not saved yet: the events")
        before = status()
        until(lambda: status().updates > before.updates + 20)
        assert any(text.startswith("the checkpoint has been writing for ") for text in status().problems)
        learner.stop.set()
        outcome = learner.join()
        assert (outcome.finished, outcome.saved) == (False, False)
        assert count("the last checkpoint, at ") == 1
        assert checkpoints(tmp_path / "run") == saved
    finally:
        back.set()
    assert load_newest(tmp_path / "run").policy.directory == saved[0]
    actor.stop.set()
    actor.join()


def test_run_that_finished_during_a_rollout_of_an_earlier_epoch_is_over(
    network: MemoryNetwork, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(actor_server, "_LEAVE_SECONDS", 0.0)
    stopped = LearnerProcess(network, tmp_path / "run")
    slow, fast = GatedActor(network, "slow"), GatedActor(network, "fast")
    slow.await_rollout()
    fast.open_gate()
    until(lambda: count("joined run") == 2)
    stopped.stop.set()
    stopped.join()
    assert LearnerProcess(network, tmp_path / "run", env_steps=1, resume=True).join().finished
    assert fast.join()
    slow.open_gate()
    assert slow.join()


def test_drained_actor_leaves_after_its_rollout_and_the_others_play_on(network: MemoryNetwork, tmp_path: Path) -> None:
    learner = LearnerProcess(network, tmp_path / "run")
    leaving, staying = GatedActor(network, "leaving"), GatedActor(network, "staying")
    leaving.await_rollout()
    staying.await_rollout()
    assert order_to(network, "drain", "leaving") == Acknowledgement(verdict="accepted")
    unknown = order_to(network, "drain", "other")
    assert isinstance(unknown, Refusal)
    assert "no actor 'other' takes part" in unknown.reason
    leaving.open_gate()
    assert leaving.join() is False
    assert count("run 'run': drained by operator alice at laptop: this actor leaves the run") == 1
    staying.collector.waiting.clear()
    staying.open_gate()
    for _ in range(2):
        staying.await_rollout()
        staying.collector.waiting.clear()
    again = GatedActor(network, "leaving", incarnation=2)  # another process of that name may take part
    again.await_rollout()
    learner.stop.set()
    learner.join()
    for actor in (staying, again):
        actor.stop.set()
        actor.open_gate()
        actor.join()


def test_evaluator_leaves_between_two_evaluations(network: MemoryNetwork, tmp_path: Path) -> None:
    learner = LearnerProcess(network, tmp_path / "run", env_steps=1)
    transport, actor = MemoryTransport(network), GatedActor(network, "actor")
    evaluator = Evaluator(ActorConfig(name="evaluator", incarnation=1), transport, threading.Event())
    actor.await_rollout()
    working = threading.Thread(target=evaluator.run, daemon=True)
    working.start()
    until(lambda: count("run 'run': 10 greedy episodes of CartPole-v1 every 60 s") == 1)
    actor.open_gate()
    assert learner.join().finished
    working.join(30.0)
    assert not working.is_alive()
