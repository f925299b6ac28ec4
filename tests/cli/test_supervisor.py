"""Test of launch/supervision.py: the processes of `daedalus train`."""

import os
import signal
import subprocess
import sys
import threading
from collections.abc import Set
from pathlib import Path
from typing import Any

import pytest
from processes import LIMIT, until

from daedalus.launch import supervision
from daedalus.launch.local_run import LocalRun, RunObserver
from daedalus.launch.local_training import watch
from daedalus.launch.process_lifecycle import STOPPED, UNSAVED
from daedalus.launch.supervision import Child, FailedError, Supervised, stop, supervised_actor
from daedalus.protocol.spec import EnvironmentSpec, RunSpec


@pytest.mark.skipif(not hasattr(os, "setpriority"), reason="this system has no process priorities")
def test_an_actor_has_a_lower_priority_than_the_learner() -> None:
    actor = supervised_actor(
        "actor-0", "tcp/127.0.0.1:1"
    )  # nothing listens at this address: the actor continues to look for a learner
    try:
        ours = os.getpriority(os.PRIO_PROCESS, 0)
        assert os.getpriority(os.PRIO_PROCESS, actor.process.pid) == min(ours + 5, 19)
    finally:
        stop([actor.process])


def supervised(program: str, ended: Set[int] = frozenset({0}), **options: Any) -> Supervised:
    """Return a supervised process that runs a line of Python."""

    def begin(first: bool) -> subprocess.Popen[bytes]:
        return subprocess.Popen([sys.executable, "-S", "-c", program, str(first)], stdin=subprocess.PIPE)

    return Supervised("worker", begin, ended, **options)


def message(process: Supervised) -> str:
    """Check the process until there is a message; return the message."""
    found: list[str] = []
    until(lambda: found.append(process.check() or "") or found[-1])
    return found[-1]


SLEEP = "import time; time.sleep(1000)"


def test_a_killed_process_is_restarted_with_the_argument_for_a_restart() -> None:
    process = supervised(f"import sys; sys.argv[1] == 'True' or sys.exit(0); {SLEEP}")
    try:
        assert process.check() is None
        process.process.kill()
        assert message(process) == "worker was killed by signal 9; started again"
        assert process.process.wait(LIMIT) == 0
        assert process.check() is None
        assert (process.restarts, process.failures) == (1, 0)
    finally:
        stop([process.process])


def test_a_process_that_failed_three_times_is_not_restarted() -> None:
    process = supervised("raise SystemExit(7)")
    process.process.wait(LIMIT)
    assert process.failed_at_once
    assert [message(process), message(process)] == ["worker failed with status 7; started again"] * 2
    assert not process.failed_at_once
    with pytest.raises(FailedError, match="worker failed 3 times"):
        message(process)
    stop([process.process])


@pytest.mark.parametrize(
    ("program", "options", "said", "failure"),
    [
        (
            "import os, signal; os.kill(os.getpid(), signal.SIGSEGV)",
            {},
            "was killed by signal 11",
            r"failed 3 times: a fault of native code \(signal 11\)",
        ),
        (f"raise SystemExit({STOPPED})", {"no_fault": {}}, f"failed with status {STOPPED}", "failed 3 times"),
        ("pass", {}, "ended before the run", "ended 3 times before the run"),
    ],
    ids=["crashes", "has the status of a stopped learner, and is none", "ends, as a module of the user may let it"],
)
def test_a_process_that_ends_three_times_is_not_restarted(
    monkeypatch: pytest.MonkeyPatch, program: str, options: dict[str, Any], said: str, failure: str
) -> None:
    # Else an ended process is restarted after 30 s, in which the others may end, too.
    monkeypatch.setattr(supervision, "_LEAVING_SECONDS", 0.0)
    process = supervised(program, **options)
    assert [message(process), message(process)] == [f"worker {said}; started again"] * 2
    with pytest.raises(FailedError, match=f"worker {failure}"):
        message(process)
    stop([process.process])


def test_a_process_that_is_killed_from_outside_is_always_restarted() -> None:
    process = supervised(SLEEP)
    for _ in range(5):
        process.process.kill()
        assert message(process) == "worker was killed by signal 9; started again"
    assert process.failures == 0
    stop([process.process])


def test_a_crash_long_after_the_start_does_not_add_up(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(supervision, "_SOON_SECONDS", 0.0)
    process = supervised("import os; os.abort()")
    for _ in range(5):
        assert message(process) == "worker was killed by signal 6; started again"
    stop([process.process])


def test_groups_of_processes_that_do_not_end_are_killed_within_one_grace() -> None:
    waits: list[float | None] = []

    class Recorded(subprocess.Popen[bytes]):
        def wait(self, timeout: float | None = None) -> int:
            waits.append(timeout)
            return super().wait(timeout)

    frozen = [Recorded([sys.executable, "-S", "-c", SLEEP]) for _ in range(2)]
    for process in frozen:
        process.send_signal(signal.SIGSTOP)
        os.waitid(os.P_PID, process.pid, os.WSTOPPED)
    stop(frozen[:1], frozen[1:], grace_seconds=0.5)
    assert all(process.returncode < 0 for process in frozen)
    first, killed, *second = waits
    assert first is not None
    assert 0.0 < first <= 0.5
    assert killed is None
    assert second == [0.0, None]


def test_an_actor_fails_for_the_reason_that_it_prints() -> None:
    said = {"actor-0": "daedalus actor: environment Mine-v0: step raises ValueError: no map (mine.py, line 3)"}
    actor = supervised_actor("actor-0", "tcp/127.0.0.1:1", last_error=lambda name: said[name])
    try:
        assert actor.no_fault == {}
        assert actor.reason(1) == "environment Mine-v0: step raises ValueError: no map (mine.py, line 3)"
        crashed = "the environment ends the process ({}): play it with `daedalus check`"
        assert [actor.reason(5), actor.reason(-11)] == [crashed.format("status 5"), crashed.format("signal 11")]
    finally:
        stop([actor.process])


def test_a_learner_that_a_signal_stopped_has_not_failed() -> None:
    process = supervised(f"raise SystemExit({STOPPED})")
    for _ in range(5):
        process.process.wait(LIMIT)
        assert not process.failed_at_once
        assert message(process) == "worker was stopped by a signal; started again"
    stop([process.process])


def test_failures_long_after_the_start_do_not_add_up(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(supervision, "_SOON_SECONDS", 0.0)
    process = supervised("raise SystemExit(7)")
    for _ in range(5):
        message(process)
    process.process.wait(LIMIT)
    assert not process.failed_at_once
    stop([process.process])


def test_a_process_that_ended_before_the_others_is_restarted(monkeypatch: pytest.MonkeyPatch) -> None:
    process = supervised("pass")
    process.process.wait(LIMIT)
    assert process.check() is None
    assert process.restarts == 0
    monkeypatch.setattr(supervision, "_LEAVING_SECONDS", 0.0)
    assert message(process) == "worker ended before the run; started again"
    stop([process.process])


@pytest.mark.parametrize(("algorithm", "continues"), [("impala", True), ("a2c", False)])
def test_training_continues_without_a_failed_actor_unless_the_algorithm_is_synchronous(
    algorithm: str, continues: bool, caplog: pytest.LogCaptureFixture, tmp_path: Path
) -> None:
    spec = RunSpec.model_validate({"environment": {"id": "CartPole-v1"}, "training": {"algorithm": algorithm}})
    run = LocalRun(directory=tmp_path, spec=spec, started=0.0)
    learner, actors = supervised(SLEEP), [supervised("raise SystemExit(7)") for _ in range(2)]
    evaluator = supervised("raise SystemExit(7)")
    evaluator.name = "evaluator"
    processes = [*actors, evaluator, learner]
    try:
        failed = "all actors failed: see the error above" if continues else "worker failed 3 times"
        with pytest.raises(FailedError, match=failed):
            watch(learner, [evaluator, *actors], run, threading.Event())
        continued = "worker failed 3 times: see the error above; training continues without this process"
        assert any(continued in message for message in caplog.messages) == continues
    finally:
        stop([each.process for each in processes])


def test_training_that_has_finished_is_not_failed_by_actors_that_fail_at_its_end(tmp_path: Path) -> None:
    spec = RunSpec(environment=EnvironmentSpec(id="CartPole-v1"))
    run = LocalRun(directory=tmp_path, spec=spec, started=0.0)
    ready = tmp_path / "ready"
    learner = supervised(
        "import signal, sys; signal.signal(signal.SIGTERM, lambda *_: sys.exit(3)); "
        f"open({str(ready)!r}, 'x'); {SLEEP}",
        ended={0, 3},
    )
    until(ready.exists)
    actor = supervised("raise SystemExit(7)")
    try:
        assert watch(learner, [actor], run, threading.Event()) == 3
    finally:
        stop([learner.process, actor.process])


def test_training_that_a_callback_ended_is_not_evaluated_if_its_last_checkpoint_could_not_be_saved(
    tmp_path: Path,
) -> None:
    class Ending(RunObserver):
        def poll(self, learner: Child) -> bool:
            return (tmp_path / "ready").exists()

    spec = RunSpec(environment=EnvironmentSpec(id="CartPole-v1"))
    run = LocalRun(directory=tmp_path, spec=spec, started=0.0, observer=Ending())
    learner = supervised(
        f"import signal, sys; signal.signal(signal.SIGTERM, lambda *_: sys.exit({UNSAVED})); "
        f"open({str(tmp_path / 'ready')!r}, 'x'); {SLEEP}"
    )
    try:
        assert watch(learner, [], run, threading.Event()) == UNSAVED
    finally:
        stop([learner.process])
