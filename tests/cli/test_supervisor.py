"""cli/supervisor.py: the processes of `daedalus train`."""

import os
import subprocess
import sys
import threading
from collections.abc import Set

import pytest
from processes import LIMIT, until

from daedalus.cli import supervisor
from daedalus.cli.local_run import watch
from daedalus.cli.supervisor import FailedError, Supervised, stop, supervised_actor
from daedalus.protocol.spec import RunSpec


@pytest.mark.skipif(not hasattr(os, "setpriority"), reason="processes have no priorities here")
def test_actors_come_after_the_learner() -> None:
    actor = supervised_actor("actor-0", "tcp/127.0.0.1:1")  # nobody listens there: it goes on looking
    try:
        ours = os.getpriority(os.PRIO_PROCESS, 0)
        assert os.getpriority(os.PRIO_PROCESS, actor.process.pid) == min(ours + 5, 19)
    finally:
        stop([actor.process])


def supervised(program: str, ended: Set[int] = frozenset({0})) -> Supervised:
    """A process that runs a line of Python."""

    def begin(first: bool) -> subprocess.Popen[bytes]:
        return subprocess.Popen([sys.executable, "-S", "-c", program, str(first)], stdin=subprocess.PIPE)

    return Supervised("it", begin, ended)


def news(process: Supervised) -> str:
    """What the next check that has something to say tells."""
    found: list[str] = []
    until(lambda: found.append(process.check() or "") or found[-1])
    return found[-1]


SLEEP = "import time; time.sleep(1000)"


def test_a_killed_process_is_started_again_and_told_that_it_is_not_the_first() -> None:
    process = supervised(f"import sys; sys.argv[1] == 'True' or sys.exit(0); {SLEEP}")
    try:
        assert process.check() is None
        process.process.kill()
        assert news(process) == "it was killed by signal 9; started again"
        assert process.process.wait(LIMIT) == 0
        assert process.check() is None
        assert (process.restarts, process.failures) == (1, 0)
    finally:
        stop([process.process])


def test_a_process_that_fails_by_itself_is_given_up_after_the_third_time() -> None:
    process = supervised("raise SystemExit(7)")
    process.process.wait(LIMIT)
    assert process.failed_at_once
    assert [news(process), news(process)] == ["it failed with status 7; started again"] * 2
    assert not process.failed_at_once
    with pytest.raises(FailedError, match="it failed 3 times"):
        news(process)
    stop([process.process])


def test_failures_far_apart_do_not_add_up(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(supervisor, "_SOON_SECONDS", 0.0)
    process = supervised("raise SystemExit(7)")
    for _ in range(5):
        news(process)
    process.process.wait(LIMIT)
    assert not process.failed_at_once
    stop([process.process])


def test_who_left_while_the_others_go_on_is_fetched_back(monkeypatch: pytest.MonkeyPatch) -> None:
    process = supervised("pass")
    process.process.wait(LIMIT)
    assert process.check() is None
    assert process.restarts == 0
    monkeypatch.setattr(supervisor, "_LEAVING_SECONDS", 0.0)
    assert news(process) == "it had left; started again"
    stop([process.process])


@pytest.mark.parametrize(("algorithm", "told"), [("impala", True), ("a2c", False)])
def test_training_goes_on_without_an_actor_that_fails_for_good_unless_it_is_needed(
    algorithm: str, told: bool, caplog: pytest.LogCaptureFixture
) -> None:
    spec = RunSpec.model_validate({"environment": {"id": "CartPole-v1"}, "training": {"algorithm": algorithm}})
    learner, actors = supervised(SLEEP), [supervised("raise SystemExit(7)") for _ in range(2)]
    evaluator = supervised("raise SystemExit(7)")
    evaluator.name = "evaluator"
    processes = [*actors, evaluator, learner]
    try:
        with pytest.raises(FailedError, match="it failed 3 times"):
            watch(learner, [evaluator, *actors], spec, threading.Event())
        assert (
            any("it failed 3 times; its error is above; going on without it" in text for text in caplog.messages)
            == told
        )
    finally:
        stop([each.process for each in processes])
