"""launch/environment_check.py: the check in a process of its own, and what a run takes from it."""

import os
import signal
import subprocess
import sys
import threading
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from building import run_spec
from log_lines import LINES
from plain import array_space, vector_spaces
from processes import LIMIT, until

from daedalus.launch import environment_check as module
from daedalus.launch.environment_check import (
    CheckTimeoutError,
    EnvironmentProblemError,
    checked_defaults,
    checked_spaces,
    expected_defaults,
    expected_spaces,
    quick_check,
    transformed_spaces,
)
from daedalus.launch.run_choice import RunChoice
from daedalus.learner.run.default_settings import default_settings
from daedalus.policy.user_modules import NO_MODULES, UserModules
from daedalus.protocol.lessons import LessonSpec
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
    assert array_space(spaces).shape == (2,)
    assert "the value 731.5 at index 1, but observation_space goes from -1 to 1" in "\n".join(LINES)


def test_a_value_of_a_lesson_that_the_environment_refuses_is_a_problem() -> None:
    path = EnvironmentSpec(id="lesson_environment:PathWithMethod", parameters={"stones": 7})
    lessons = {"stones": LessonSpec(between=(1, 200))}
    with pytest.raises(EnvironmentProblemError, match=r"set_parameters\(stones=200\) raises .* change lessons.stones"):
        checked_spaces(run(path).model_copy(update={"lessons": lessons}), fork=True)


def test_a_value_that_is_no_code_is_a_problem() -> None:
    grid = RunChoice(
        env="faulty_environments:Faulty-v0",
        settings={"environment.kwargs": {"fault": "map", "value": 9}, "policy.codes": {"observation": [9]}},
    )
    for check in (lambda: checked_spaces(grid.spec(), fork=True), lambda: checked_defaults(grid.spec, fork=True)):
        with pytest.raises(EnvironmentProblemError, match=r"the value 9 where policy\.codes\.observation has 9"):
            check()


def test_an_environment_that_ends_its_process_is_a_problem() -> None:
    with pytest.raises(EnvironmentProblemError, match=r"Faulty-v0 ended its process \(status 7\): see what it prints"):
        checked_spaces(run(faulty("crash")))


def test_a_run_does_not_wait_for_an_environment_that_hangs(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "_MOST_SECONDS", 0.5)
    assert checked_spaces(run(faulty("hang"))) is None
    assert "the check of the environment was not done within 0.5 s: the run starts without it" in LINES[-1]
    assert "an actor makes its 3 environments in turn: --set environment.processes=true makes them" in LINES[-1]
    assert checked_spaces(run(faulty("hang").model_copy(update={"processes": True}))) is None
    assert LINES[-1].endswith("the run starts without it")


def test_a_run_waits_longer_where_its_settings_depend_on_the_environment(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "_MOST_SECONDS", 0.0)
    spaces, _ = checked_defaults(lambda _: run(faulty("")))
    assert spaces is not None
    assert "takes long: waiting up to 120 s, because its spaces decide the settings" in LINES[-1]


def test_slow_environments_get_processes_of_their_own_unless_the_user_has_chosen() -> None:
    slow = RunChoice(env="slow_environment:Slow-v0", assignments=["environment.kwargs.seconds=0.01"])
    _, defaults = checked_defaults(slow.spec)
    assert slow.spec(defaults).environment.processes
    assert LINES[-1].endswith(" a rollout; each gets a process of its own instead (environment.processes=true)")
    before = len(LINES)
    chosen = replace(slow, assignments=[*slow.assignments, "environment.processes=false"])
    _, defaults = checked_defaults(chosen.spec)
    assert not chosen.spec(defaults).environment.processes
    assert len(LINES) == before


def test_default_settings_without_spaces_are_a_warning(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "_MOST_SECONDS_FOR_SETTINGS", 0.5)
    spaces, defaults = expected_defaults(lambda _: run(faulty("hang")), MODULES, threading.Event())
    assert (spaces, defaults) == (None, default_settings(None))
    assert "the check of environment faulty_environments:Faulty-v0 was not done within 0.5 s" in LINES[-2]
    assert "the default settings are those for numbers and discrete actions" in LINES[-1]
    expected_defaults(RunChoice(env="my-arm", algorithm="sac").spec, NO_MODULES, threading.Event())
    assert "those for numbers, because" in LINES[-1]
    assert "if it has images, name" in LINES[-1]


@pytest.mark.parametrize(("fault", "convolved"), [("board", True), ("driven board", False)])
def test_a_map_is_convolved_by_default_and_that_is_said(fault: str, convolved: bool) -> None:
    spaces, defaults = expected_defaults(lambda _: run(faulty(fault)), MODULES, threading.Event())
    assert spaces is not None
    assert (defaults["policy"].get("encoder") == "grid") is convolved
    assert any("is a map of a few cells: by default policy.encoder=grid" in line for line in LINES) is convolved


def test_a_stopped_check_ends_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    started: list[subprocess.Popen[Any]] = []

    def popen(*arguments: Any, **options: Any) -> subprocess.Popen[Any]:
        started.append(start(*arguments, **options))
        return started[-1]

    start = subprocess.Popen
    monkeypatch.setattr(subprocess, "Popen", popen)
    monkeypatch.setattr(module, "_MOST_SECONDS", 10 * LIMIT)
    stop, ended = threading.Event(), threading.Event()
    stop.set()

    def check() -> None:
        with pytest.raises(CheckTimeoutError):
            quick_check(faulty("hang"), MODULES, stop=stop)
        ended.set()

    threading.Thread(target=check, daemon=True).start()
    assert ended.wait(LIMIT)
    (process,) = started
    assert process.returncode == -signal.SIGKILL


@pytest.mark.parametrize("fork", [False, True])
def test_a_check_that_is_not_done_in_time_ends_the_programs_that_its_environment_started(
    tmp_path: Path, fork: bool
) -> None:
    """A simulator that starts slowly would occupy the port that the actor's needs."""
    (tmp_path / "slow_simulator.py").write_text(
        "import gymnasium, pathlib, subprocess, sys, time\n"
        "def start(file):\n"
        "    simulator = subprocess.Popen([sys.executable, '-S', '-c', 'import time; time.sleep(1000)'])\n"
        "    pathlib.Path('new').write_text(str(simulator.pid))\n"
        "    pathlib.Path('new').rename(file)\n"
        "    time.sleep(1000)\n"
        "gymnasium.register('Slow-v0', start)\n"
    )
    file = tmp_path / "pid"
    program = (
        "import sys\n"
        "from daedalus.launch import environment_check as module\n"
        "from daedalus.policy.user_modules import UserModules\n"
        "from daedalus.protocol.spec import EnvironmentSpec\n"
        "module._MOST_SECONDS = 1000.0\n"
        "class Stop:\n"
        "    def is_set(self): return __import__('os').path.exists('pid')\n"
        "spec = EnvironmentSpec(id='slow_simulator:Slow-v0', kwargs={'file': 'pid'})\n"
        f"module.quick_check(spec, UserModules(frozenset({{'slow_simulator'}})), fork={fork}, stop=Stop())\n"
    )
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([str(tmp_path), os.environ.get("PYTHONPATH", "")])}
    command = [sys.executable, "-c", program]
    result = subprocess.run(
        command, cwd=tmp_path, env=environment, capture_output=True, text=True, check=False, timeout=LIMIT
    )
    assert "CheckTimeoutError" in result.stderr
    until(lambda: _has_ended(int(file.read_text())))


def _has_ended(pid: int) -> bool:
    """Return whether a process has ended; one that nobody waits for counts, too."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] == "Z"
    except OSError:
        return True


def test_a_fork_gives_the_same_report_and_leaves_the_module_out_of_the_parent() -> None:
    program = (
        f"import sys; sys.path += {[str(TESTS), str(TESTS / 'cli')]}; "
        "from test_quick_check import MODULES, faulty; from daedalus.launch.environment_check import quick_check; "
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


def test_a_learner_says_what_its_default_settings_remove_from_images() -> None:
    choice = RunChoice(env="faulty_environments:Faulty-v0", assignments=["environment.kwargs.fault=photo"])
    spaces, defaults = expected_defaults(choice.spec, MODULES, threading.Event())
    assert spaces is not None
    assert defaults["environment"]["grey"] is True
    assert "is made grey and 84 x 84 pixels small for the policy" in LINES[-2]
    assert "made and not played here" in LINES[-1]


def mission(**settings: object) -> RunSpec:
    return run(EnvironmentSpec.model_validate({"id": "mission_environment:Mission-v0", **settings}))


def test_default_settings_leave_out_a_text_that_never_changes() -> None:
    modules, stop = UserModules(frozenset({"mission_environment"})), threading.Event()
    for spaces, defaults in (
        checked_defaults(lambda _: mission()),
        expected_defaults(lambda _: mission(), modules, stop),
    ):
        assert spaces is not None
        assert list(spaces.observations) == ["step"]
        assert defaults["environment"]["leave_out"] == ["mission"]
    line = "observation component 'mission' is left out (environment.leave_out): it is always 'open the door'"
    assert LINES.count(line) == 2


def test_settings_of_a_preset_must_leave_out_a_text_themselves() -> None:
    with pytest.raises(EnvironmentProblemError, match=r"component 'mission' is a text.*environment.leave_out"):
        checked_spaces(mission())
    with pytest.raises(EnvironmentProblemError, match=r"component 'mission' is a text.*environment.leave_out"):
        transformed_spaces(mission(), mission(frame_stack=2), vector_spaces(1, 2))
    stop = threading.Event()
    assert expected_spaces(mission(), UserModules(frozenset({"mission_environment"})), stop) is None
    assert "component 'mission' is a text" in LINES[-1]
    assert checked_spaces(mission(leave_out=["mission"])) is not None
