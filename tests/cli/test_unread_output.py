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
