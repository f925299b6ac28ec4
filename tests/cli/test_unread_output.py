"""Commands whose output is not read to its end, as in `daedalus status | head`, or cannot be encoded."""

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest
from recorded_runs import record

from daedalus.launch.process_lifecycle import UNREAD, exit_status

PROGRAM = "from daedalus.cli.main import main; raise SystemExit(main())"
# Runs the commands of its argument, a list of their words, in turn.
EACH = """
import ast, sys
from daedalus.cli.main import main

for words in ast.literal_eval(sys.argv[1]):
    sys.argv[1:] = words
    print("status", main(), flush=True)
"""


@pytest.mark.parametrize("words", [("completion", "bash"), ("--help",)])
def test_a_command_ends_silently_when_nobody_reads_its_output(words: tuple[str, ...]) -> None:
    reading, writing = os.pipe()
    os.close(reading)
    command = [sys.executable, "-P", "-c", PROGRAM, *words]
    try:
        result = subprocess.run(command, stdout=writing, stderr=subprocess.PIPE, text=True)
    finally:
        os.close(writing)
    assert (result.returncode, result.stderr) == (UNREAD, "")


def test_another_broken_pipe_is_not_hidden(capfd: pytest.CaptureFixture[str]) -> None:
    def fail() -> int:
        raise BrokenPipeError

    with capfd.disabled(), pytest.raises(BrokenPipeError):
        exit_status(fail)
    assert exit_status(lambda: 7) == 7


@pytest.mark.skipif(not os.path.exists("/dev/full"), reason="this system has no device that is always full")
@pytest.mark.parametrize("buffering", ["", "1"])
def test_output_that_cannot_be_written_is_one_line(buffering: str) -> None:
    command = [sys.executable, "-P", "-c", PROGRAM, "--help"]
    environment = {**os.environ, "PYTHONUNBUFFERED": buffering}
    with open("/dev/full", "w") as full:
        result = subprocess.run(command, stdout=full, stderr=subprocess.PIPE, text=True, env=environment)
    assert (result.returncode, result.stderr) == (1, "daedalus: cannot write the output: No space left on device\n")


@pytest.mark.skipif(not os.path.exists("/dev/full"), reason="this system has no device that is always full")
@pytest.mark.parametrize("buffering", ["", "1"])
def test_a_finished_run_does_not_fail_because_its_result_cannot_be_printed(buffering: str) -> None:
    program = (
        "from daedalus.launch.process_lifecycle import exit_status\n"
        "from daedalus.cli.commands.train import show\n"
        "raise SystemExit(exit_status(lambda: show('the result', 'daedalus resume') or 3))"
    )
    command = [sys.executable, "-P", "-c", program]
    environment = {**os.environ, "PYTHONUNBUFFERED": buffering}
    with open("/dev/full", "w") as full:
        result = subprocess.run(command, stdout=full, stderr=subprocess.PIPE, text=True, env=environment)
    assert result.returncode == 3, result.stderr
    assert result.stderr == (
        "daedalus resume: cannot print the result, which is in the run directory: No space left on device\n"
    )


NAME = (
    "r\u00e9\udcff\u202e\u2028$x\x1b[2J"  # of a directory: an accent, a byte, marks of direction, a new line, a control
)


@pytest.mark.parametrize("encoding", ["ascii", "utf-8", "latin-1:strict"])
def test_a_command_prints_any_path_in_characters_that_its_output_has(tmp_path: Path, encoding: str) -> None:
    variables = {**os.environ, "PYTHONIOENCODING": encoding, "LC_ALL": "C.UTF-8"}
    commands = [(0, "compare", NAME, "--csv", f"{NAME}.csv")]
    if encoding == "ascii":  # the others print in the same ways
        commands += [
            (0, "report", NAME),
            (0, "plot", NAME, "--output", f"{NAME}.png"),
            (2, "resume", f"{NAME}-missing"),
            (1, "status", "--alive", f"{NAME}-missing"),
        ]
    commands += [(1, "evaluate", f"{NAME}-missing")]  # last: its process replaces this one
    record(tmp_path / NAME)
    command = [sys.executable, "-P", "-c", EACH, *(ascii([list(words) for _, *words in commands]),)]
    ended = subprocess.run(command, cwd=tmp_path, env=variables, capture_output=True, check=False)
    text = (ended.stdout + ended.stderr).decode(encoding.partition(":")[0])
    assert "Traceback" not in text
    assert all(line.isprintable() for line in text.split("\n")), text
    *statuses, last = (status for status, *_ in commands)
    assert (re.findall(r"^status (\d+)$", text, re.MULTILINE), ended.returncode) == ([*map(str, statuses)], last), text
    shown = r"r\xe9\udcff\u202e\u2028$x\x1b[2J".replace(r"\xe9", r"\xe9" if encoding == "ascii" else "é")
    assert f"\n{shown} " in text.partition("status ")[0]  # in the table of `compare`
    assert all(line.isprintable() for line in (tmp_path / f"{NAME}.csv").read_text("utf-8").splitlines())
    if encoding == "ascii":
        assert f"wrote {shown}/report.html\n" in text
        page = (tmp_path / NAME / "report.html").read_text("utf-8")
        assert all(character.isprintable() or character == "\n" for character in page)
