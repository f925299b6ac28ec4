"""Commands whose output is not read to its end, as in `daedalus status | head`."""

import os
import subprocess
import sys

import pytest

from daedalus.cli.processes import UNREAD, exit_status

PROGRAM = "from daedalus.cli.main import main; raise SystemExit(main())"


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
        "from daedalus.cli.processes import exit_status\n"
        "from daedalus.cli.run_report import show\n"
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
