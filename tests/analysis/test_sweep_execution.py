"""Test of analysis/sweep_execution.py and of its processes, with small programs in place of `daedalus train`."""

import io
import shutil
import subprocess
import sys
import threading
import time
from collections.abc import Sequence
from pathlib import Path
from typing import IO

import pytest
from planning import finish, planner
from processes import LIMIT, processes_mentioning, until
from terminal import TerminalStream

from daedalus.analysis import sweep_execution
from daedalus.analysis.sweep_execution import (
    CURVES,
    RUNS,
    TABLE,
    Display,
    RunProcesses,
    Sweep,
    SweepEnd,
    newest_row,
    reason,
    report,
)
from daedalus.analysis.sweep_plan import Choices, PlannedRun
from daedalus.analysis.sweep_search import GridSearch
from daedalus.learner.run.run_directory import write_config

LENGTH = "collection.rollout_length"
FAIL = "print('some output'); print('daedalus train: the reason'); raise SystemExit(1)"


class Programs:
    """Starts small programs as runs, and counts how many run side by side."""

    def __init__(self, programs: dict[str, str] | None = None) -> None:
        self.programs = programs or {}  # by the name of the run; the others end at once with a result
        self.begun: list[str] = []
        self.most = 0
        self._alive: list[subprocess.Popen[bytes]] = []

    def start(self, run: PlannedRun, log: IO[bytes]) -> "subprocess.Popen[bytes]":
        self.begun.append(run.name)
        program = self.programs.get(run.name, "")
        if not program:
            shutil.rmtree(run.directory, ignore_errors=True)
            finish(run, evaluation=float(run.spec.collection.rollout_length))
        process = subprocess.Popen(
            [sys.executable, "-c", program],
            stdin=subprocess.PIPE,
            stdout=log,
            stderr=subprocess.STDOUT,
            start_new_session=True,
        )
        self._alive = [other for other in self._alive if other.poll() is None] + [process]
        self.most = max(self.most, len(self._alive))
        return process


def grid(folder: Path, values: Sequence[str] = ("5", "20"), seeds: int = 2) -> GridSearch:
    return GridSearch(planner(folder), [Choices(key=LENGTH, values=tuple(values))], range(1, 1 + seeds))


def make(
    search: GridSearch, programs: Programs, jobs: int = 1, stopping: threading.Event | None = None
) -> tuple[SweepEnd, str]:
    stream = io.StringIO()
    sweep = Sweep(search, RunProcesses(jobs, programs.start), Display(stream, search.total))
    return sweep.run(stopping or threading.Event()), stream.getvalue()


def test_all_runs_are_made_one_after_another(tmp_path: Path) -> None:
    search, programs = grid(tmp_path), Programs()
    end, output = make(search, programs)
    assert programs.begun == [run.name for run in search.planned]
    assert [run.name for run in end.done] == programs.begun
    assert programs.most == 1
    assert "rollout_length-5_seed-1: begins" in output
    assert "rollout_length-5_seed-1: done after 3,000 env_steps, 9 s; final return 5" in output


def test_runs_are_made_side_by_side(tmp_path: Path) -> None:
    waiting = "import sys; sys.stdin.read()"
    programs = Programs(dict.fromkeys((f"rollout_length-{n}_seed-{s}" for n in (5, 20) for s in (1, 2)), waiting))
    stopping = threading.Event()
    thread = threading.Thread(target=make, args=(grid(tmp_path), programs, 3, stopping))
    thread.start()
    until(lambda: len(programs.begun) == 3)
    time.sleep(0.3)  # a fourth would have started
    stopping.set()
    thread.join(LIMIT)
    assert not thread.is_alive()
    assert programs.most == len(programs.begun) == 3


def test_a_run_that_has_ended_is_not_repeated_and_one_that_has_begun_is_continued(tmp_path: Path) -> None:
    search, programs = grid(tmp_path), Programs()
    first, second, *_ = search.planned
    finish(first)
    write_config_only(second)
    end, output = make(search, programs)
    assert programs.begun == [run.name for run in search.planned[1:]]
    assert "1 of 4 runs had ended before" in output
    assert f"{second.name}: continues" in output
    assert len(end.done) == 4


def write_config_only(run: PlannedRun) -> None:
    run.directory.mkdir()
    write_config(run.directory, run.spec)


def test_a_failed_run_has_a_reason_and_does_not_stop_the_others(tmp_path: Path) -> None:
    search, programs = grid(tmp_path), Programs({"rollout_length-5_seed-1": FAIL})
    end, output = make(search, programs)
    assert end.failed == {"rollout_length-5_seed-1": "the reason"}
    assert len(end.done) == 3
    assert "rollout_length-5_seed-1: failed: the reason" in output
    text = report(tmp_path, search.planned, end, [LENGTH], ranked=False)
    assert "failed: 1 (rollout_length-5_seed-1); the same command tries them again" in text
    again = Programs()
    assert make(grid(tmp_path), again)[0].failed == {}
    assert again.begun == ["rollout_length-5_seed-1"]


def test_a_run_that_ends_without_a_result_has_failed(tmp_path: Path) -> None:
    end, _ = make(grid(tmp_path, ["5"], 1), Programs({"rollout_length-5_seed-1": "pass"}))
    log = tmp_path / "logs" / "rollout_length-5_seed-1.log"
    assert end.failed == {"rollout_length-5_seed-1": f"it ended without a result; see {log}"}


def test_no_process_is_left_after_a_stop(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """One obeys SIGTERM, and one does not: it is killed with its child."""
    monkeypatch.setattr(sweep_execution, "_GRACE_SECONDS", 0.5)
    child = f"import time; time.sleep(999)  # of {tmp_path}"
    stubborn = (
        "import signal, subprocess, sys; signal.signal(signal.SIGTERM, signal.SIG_IGN)\n"
        f"subprocess.Popen([sys.executable, '-c', {child!r}]); print('ready', flush=True)\n"
        "while True: signal.pause()"
    )
    programs = Programs(
        {"rollout_length-5_seed-1": stubborn, "rollout_length-20_seed-1": "import time; time.sleep(999)"}
    )
    stopping, ends = threading.Event(), []
    thread = threading.Thread(target=lambda: ends.append(make(grid(tmp_path), programs, 2, stopping)[0]))
    thread.start()
    log = tmp_path / "logs" / "rollout_length-5_seed-1.log"
    until(lambda: log.exists() and "ready" in log.read_text())
    stopping.set()
    thread.join(LIMIT)
    assert not thread.is_alive()
    assert ends[0].stopped
    assert [process.poll() for process in programs._alive] == [-9, -15]
    until(lambda: not processes_mentioning(child))


def test_the_results_are_tables_and_a_picture(tmp_path: Path) -> None:
    search = grid(tmp_path)
    end, _ = make(search, Programs())
    text = report(tmp_path, search.planned, end, [LENGTH], ranked=False)
    rows = [line.split() for line in text.splitlines() if line.startswith("rollout_length=")]
    assert [row[:3] for row in rows] == [["rollout_length=5", "2", "5"], ["rollout_length=20", "2", "20.0"]]
    ranked = report(tmp_path, search.planned, end, [LENGTH], ranked=True)
    first = next(line for line in ranked.splitlines() if line.startswith("rollout_length="))
    assert first.startswith("rollout_length=20 ")
    lines = (tmp_path / RUNS).read_text().splitlines()
    assert lines[:2] == [
        "run,rollout_length,seed,state,final_return,env_steps,minutes,reached_target",
        "rollout_length-5_seed-1,5,1,done,5.0,3000,0.15,False",
    ]
    assert len((tmp_path / TABLE).read_text().splitlines()) == 3
    pytest.importorskip("matplotlib")
    assert (tmp_path / CURVES).exists()


def test_without_matplotlib_the_report_says_how_to_install_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    search = grid(tmp_path)
    end, _ = make(search, Programs())
    text = report(tmp_path, search.planned, end, [LENGTH], ranked=False)
    assert 'no picture: matplotlib is not installed: pip install "daedalus-rl[analysis]"' in text
    assert "rollout_length=20" in text


@pytest.mark.parametrize(
    ("output", "expected"),
    [
        ("a\ndaedalus train: first\ndaedalus resume: second\nmore\n", "second"),
        ("Traceback\n\nValueError: x\n\n", "ValueError: x"),
        ("", "exit status 7"),
    ],
)
def test_the_reason_of_a_failure_is_what_the_run_said(tmp_path: Path, output: str, expected: str) -> None:
    (tmp_path / "log").write_text(output)
    assert reason(tmp_path / "log", 7) == expected


def test_a_terminal_shows_the_runs_in_one_line(tmp_path: Path) -> None:
    (run,) = grid(tmp_path, ["5"], 1).planned
    finish(run, env_steps=150_000)
    stream = TerminalStream()
    display = Display(stream, 4)
    display.show(2, 1, [run])
    assert "2 of 4 runs  1 failed  left -  rollout_length-5_seed-1 10 % return 480.0" in stream.getvalue()
    assert "\n" not in stream.getvalue()
    display.say("a line")
    assert stream.getvalue().endswith("\r\x1b[Ka line\n")


def test_the_newest_row_is_the_last_whole_line(tmp_path: Path) -> None:
    (run,) = grid(tmp_path, ["5"], 1).planned
    assert newest_row(run) == {}
    finish(run)
    metrics = run.directory / "metrics.csv"
    assert newest_row(run)["env_steps"] == 3000.0
    whole = metrics.read_text()
    metrics.write_text(whole + "9,9")
    assert newest_row(run)["env_steps"] == 3000.0
    metrics.write_text(whole.splitlines()[0] + "\n")
    assert newest_row(run) == {}
