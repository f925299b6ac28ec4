"""Test of launch/child_output.py: the output of child processes goes to a log and, within a limit, to the screen."""

import os
import signal
import subprocess
import sys
import threading
from collections.abc import Collection
from pathlib import Path

import pytest
from processes import LIMIT, until

from daedalus.launch import child_output
from daedalus.launch.child_output import STREAMS, ChildOutput, OutputLog, RateLimit


class Screen:
    """A screen for a test, and the output that is shown on it."""

    def __init__(self, folder: Path) -> None:
        self.out: list[str] = []
        self.err: list[str] = []
        self.log = folder / "output.log"
        self.output = ChildOutput(self.log, self.out.append, self.err.append)

    def run(self, name: str, program: str, shown: Collection[str] = STREAMS) -> None:
        with self.output.pipes(name, shown=shown) as streams:
            process = subprocess.Popen(
                [sys.executable, "-S", "-c", program], stdout=streams.stdout, stderr=streams.stderr
            )
        process.wait()


@pytest.fixture
def screen(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Screen:
    monkeypatch.setattr(child_output, "_CLOSE_SECONDS", 10 * LIMIT)  # or a slow machine leaves out the last lines
    return Screen(tmp_path)


def test_a_flood_is_logged_but_not_shown_and_does_not_hide_errors(screen: Screen) -> None:
    screen.run("actor-0", "import sys\nfor n in range(10_000): print('line', n)\nprint('fault', file=sys.stderr)")
    screen.output.close()
    limit = child_output._SHOWN_AT_ONCE
    assert screen.out[:limit] == [f"line {n}" for n in range(limit)]
    assert screen.out[limit] == f"more lines of output are in {screen.log} only"
    assert screen.out[-1].endswith(f" lines of output were not shown; see {screen.log}")
    assert len(screen.out) < 2 * limit  # one line every few seconds, on the slowest machine
    assert screen.err == ["fault"]
    logged = screen.log.read_text().splitlines()
    assert [line for line in logged if "fault" not in line] == [f"[actor-0] line {n}" for n in range(10_000)]


def test_few_lines_are_all_shown_and_nothing_makes_no_log(screen: Screen) -> None:
    screen.run("silent", "pass")
    assert not screen.log.exists()
    screen.run("a", "print('one\\rtwo\\n')")
    screen.run("b", "import os; os.write(2, b'\\xff without end')")
    screen.output.close()
    assert screen.out == ["one", "two", ""]
    assert screen.err == ["\ufffd without end"]
    logged = screen.log.read_text().splitlines()  # of two processes, whose lines may come in any order
    assert [line for line in logged if line.startswith("[a]")] == ["[a] one", "[a] two", "[a] "]
    assert [line for line in logged if line.startswith("[b]")] == ["[b] \ufffd without end"]
    assert len(logged) == 4


def test_tracebacks_go_to_the_log_which_the_error_names(screen: Screen) -> None:
    fail = "import sys\ndef step(): raise ValueError('stuck')\ntry: step()\nexcept ValueError as error: 1 / 0"
    screen.run("actor-0", fail)
    where = f"the traceback of actor-0 is in {screen.log}"
    last = "ZeroDivisionError: division by zero"
    assert screen.output.last_error("actor-0") == f"{last}; the traceback is in {screen.log}"
    screen.run("actor-0", fail)
    screen.output.close()
    assert screen.err[:2] == [where, "ValueError: stuck"]
    assert screen.err.count(where) == 1
    assert last in screen.err
    assert not any("File" in line or "Traceback" in line for line in screen.err)
    logged = screen.log.read_text()
    assert logged.count("[actor-0] Traceback (most recent call last):") == 4
    assert '[actor-0]   File "<string>", line 2, in step' in logged
    assert screen.output.withheld  # so that the folder with the log is kept


PRINT_ERRORS = "import sys\nfor n in range(100): print('error', n, file=sys.stderr)"


def test_the_last_error_of_a_process_that_is_not_shown_is_known(screen: Screen) -> None:
    screen.run("evaluation-1", PRINT_ERRORS, shown=())
    assert screen.output.last_error("evaluation-1") == "error 99"
    screen.output.close()
    assert screen.err == []


def test_the_last_error_lines_of_a_process_are_shown(screen: Screen) -> None:
    for _ in range(2):
        screen.run("actor-0", PRINT_ERRORS)
        assert screen.output.last_error("actor-0") == "error 99"
        assert screen.err[-5:] == [f"error {n}" for n in range(95, 100)]
    screen.run("actor-1", "print('no error')")
    assert screen.output.last_error("actor-1") == ""
    screen.output.close()
    assert len(screen.err) < 100
    (last,) = [line for line in screen.out if "were not shown" in line]
    assert last.startswith(f"{200 - len(screen.err)} lines")


def test_unlimited_output_is_shown_and_not_logged(screen: Screen) -> None:
    with screen.output.unlimited_pipes("learner") as streams:
        words = [sys.executable, "-S", "-c", "for n in range(1000): print(n)"]
        subprocess.run(words, stdout=streams.stdout, stderr=streams.stderr, check=True)
    screen.output.close()
    assert screen.out == [str(n) for n in range(1000)]
    assert not screen.log.exists()


def test_the_end_does_not_wait_for_programs_that_a_process_has_started(screen: Screen) -> None:
    file, closed = screen.log.with_name("pid"), threading.Event()
    screen.run(
        "actor-0",
        "import pathlib, subprocess, sys\n"
        "simulator = subprocess.Popen([sys.executable, '-S', '-c', 'import time; time.sleep(1000)'])\n"
        f"pathlib.Path({str(file)!r}).write_text(str(simulator.pid))\n"
        "print(('x' * 19 + '\\n') * 10_000)\n"
        "print('the last line', file=sys.stderr)",
    )
    pid = int(file.read_text())
    try:
        threading.Thread(target=lambda: (screen.output.close(), closed.set()), daemon=True).start()
        assert closed.wait(LIMIT)
        os.kill(pid, 0)  # it runs
    finally:
        os.kill(pid, signal.SIGKILL)
    assert screen.err == ["the last line"]
    assert screen.log.read_text().count(f"[actor-0] {'x' * 19}\n") == 10_000


def test_a_line_without_end_does_not_fill_the_memory(screen: Screen, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(child_output, "_LONGEST_LINE", 1000)
    screen.run("a", "import os; os.write(1, b''.join(b'%5d' % n for n in range(6000)))")
    screen.output.close()
    assert "".join(screen.out[:31]) == "".join(f"{n:5d}" for n in range(6000))
    assert max(map(len, screen.out[:31])) < 2000


def test_a_closed_terminal_or_a_full_disk_stops_nothing(tmp_path: Path) -> None:
    def fail(_line: str) -> None:
        raise BrokenPipeError

    output = ChildOutput(tmp_path / "no such folder" / "output.log", fail, fail)
    with output.pipes("a") as streams:
        words = [sys.executable, "-S", "-c", "print(('x' * 19 + '\\n') * 10_000)"]
        assert subprocess.run(words, stdout=streams.stdout, stderr=streams.stderr).returncode == 0
    output.close()


def test_a_disk_that_does_not_answer_does_not_stop_the_processes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    answers = threading.Event()
    append = OutputLog._append

    def hang(log: OutputLog, data: bytes) -> None:
        assert answers.wait(LIMIT)
        append(log, data)

    monkeypatch.setattr(OutputLog, "_append", hang)
    monkeypatch.setattr(child_output, "_WAITING_WRITES", 2)
    monkeypatch.setattr(child_output, "_SLOW_SECONDS", 0.05)
    monkeypatch.setattr(child_output, "_CLOSE_SECONDS", 0.05)
    log = OutputLog(tmp_path / "output.log")
    for number in range(10):
        log.write([f"line {number}\n".encode()])
    log.close()  # does not wait for ever
    answers.set()

    def note_is_written() -> bool:
        log.write([b"last\n"])
        return " lines are left out: the disk was slow\nlast\n" in (tmp_path / "output.log").read_text()

    until((tmp_path / "output.log").exists)
    until(note_is_written)
    monkeypatch.setattr(child_output, "_CLOSE_SECONDS", LIMIT)
    log.close()


def test_the_log_is_bounded(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(child_output, "_LOG_BYTES", 100)
    log = OutputLog(tmp_path / "output.log")
    for number in range(100):
        log.write([f"line {number:02}\n".encode()])
    log.close()
    older, newer = (tmp_path / "output.log.1").read_text(), (tmp_path / "output.log").read_text()
    assert (older + newer).endswith("line 98\nline 99\n")
    assert 100 < len(older) < 110
    assert len(newer) <= 100
    assert len(list(tmp_path.iterdir())) == 2


def test_the_rate_limit_recovers_slowly() -> None:
    limit = RateLimit(0.0)
    assert limit.take(100, 0.0) == child_output._SHOWN_AT_ONCE
    assert limit.take(100, 1.0) == 0
    assert limit.take(100, 11.0) == 2
    assert limit.take(100, 1e6) == child_output._SHOWN_AT_ONCE


def test_a_warning_of_every_environment_is_shown_once(screen: Screen) -> None:
    warn = "import sys\nfor n in range(20): print('old attribute\\n', file=sys.stderr)\nprint('other', file=sys.stderr)"
    screen.run("actor-0", warn)
    screen.output.close()
    assert screen.err == ["old attribute", "", "other"]
    assert screen.out == []  # what was shown before does not count as withheld
    assert len(screen.log.read_text().splitlines()) == 41


def test_secrets_reach_neither_the_screen_nor_the_log_which_only_its_owner_may_read(screen: Screen) -> None:
    program = "import sys\nprint('at http://ada:pa55w0rd@host')\nprint('http://ada:pa55w0rd@host', file=sys.stderr)"
    screen.run("mlflow", program)
    assert screen.output.last_error("mlflow") == "http://***@host"
    screen.output.close()
    assert (screen.out, screen.err) == (["at http://***@host"], ["http://***@host"])
    assert "pa55w0rd" not in screen.log.read_text()
    assert screen.log.stat().st_mode & 0o777 == 0o600
