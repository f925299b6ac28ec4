"""cli/quick_check.py: the check in a process of its own, and what a run takes from it."""

import os
import subprocess
import sys
import threading
from pathlib import Path

import pytest
from building import run_spec
from log_lines import LINES

from daedalus.cli import quick_check as module
from daedalus.cli.quick_check import (
    CheckTimeoutError,
    EnvironmentProblemError,
    checked_spaces,
    expected_spaces,
    quick_check,
)
from daedalus.policy.user_modules import NO_MODULES, UserModules
from daedalus.protocol.spec import EnvironmentSpec, RunSpec

TESTS = Path(__file__).parent.parent
MODULES = UserModules(frozenset({"faulty_environments"}))


@pytest.fixture(autouse=True)
def _beside_the_module(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(TESTS)


def faulty(fault: str) -> EnvironmentSpec:
    return EnvironmentSpec(id="faulty_environments:Faulty-v0", kwargs={"fault": fault})


def run(environment: EnvironmentSpec) -> RunSpec:
    return run_spec().model_copy(update={"environment": environment})


def test_warnings_are_logged_and_the_spaces_are_returned() -> None:
    spaces = checked_spaces(run(faulty("bounds")))
    assert spaces is not None
    assert spaces.observation.shape == (2,)
    assert "the value 731.5 at index 1, but observation_space goes from -1 to 1" in "\n".join(LINES)


def test_an_environment_that_ends_its_process_is_a_problem() -> None:
    with pytest.raises(EnvironmentProblemError, match=r"Faulty-v0 ended its process \(status 7\): see what it prints"):
        checked_spaces(run(faulty("crash")))


def test_a_run_does_not_wait_for_an_environment_that_hangs(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "_MOST_SECONDS", 0.5)
    assert checked_spaces(run(faulty("hang"))) is None
    assert "the check of the environment was not done within 0.5 s: the run starts without it" in "\n".join(LINES)


def test_a_stopped_check_ends_at_once() -> None:
    stop = threading.Event()
    stop.set()
    with pytest.raises(CheckTimeoutError):
        quick_check(faulty("hang"), MODULES, stop=stop)
    with pytest.raises(ChildProcessError):
        os.waitpid(-1, os.WNOHANG)  # no child is left


def test_a_fork_gives_the_same_report_and_leaves_the_module_out_of_the_parent() -> None:
    program = (
        f"import sys; sys.path += {[str(TESTS), str(TESTS / 'cli')]}; "
        "from test_quick_check import MODULES, faulty; from daedalus.cli.quick_check import quick_check; "
        "print(quick_check(faulty('shape'), MODULES, fork=True).problems); print('faulty_environments' in sys.modules)"
    )
    result = subprocess.run([sys.executable, "-P", "-c", program], capture_output=True, text=True, check=True)
    assert result.stdout.splitlines() == [repr(quick_check(faulty("shape"), MODULES).problems), "False"]


def test_a_learner_expects_the_spaces_of_an_environment_that_it_can_make() -> None:
    stop = threading.Event()
    spaces = expected_spaces(run(faulty("nan")), MODULES, stop)  # it is made, not played
    assert spaces is not None
    assert expected_spaces(run(faulty("")), NO_MODULES, stop) is None
    assert "the first actor decides the spaces of the run" in LINES[-1]
    assert "may not be imported here" in LINES[-1]
