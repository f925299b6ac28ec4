"""cli/processes.py: limits and the end of a process."""

import resource
import subprocess
import sys
from collections.abc import Iterator

import pytest
from processes import LIMIT

from daedalus.cli.processes import exit_status, raise_descriptor_limit


@pytest.fixture
def limits() -> Iterator[tuple[int, int]]:
    before = resource.getrlimit(resource.RLIMIT_NOFILE)
    yield before
    resource.setrlimit(resource.RLIMIT_NOFILE, before)


def test_descriptor_limit_is_raised_to_the_hard_limit(limits: tuple[int, int]) -> None:
    _, hard = limits
    resource.setrlimit(resource.RLIMIT_NOFILE, (512, hard))
    raise_descriptor_limit()
    assert resource.getrlimit(resource.RLIMIT_NOFILE) == (hard, hard)
    raise_descriptor_limit()
    assert resource.getrlimit(resource.RLIMIT_NOFILE) == (hard, hard)


def test_ctrl_c_prints_no_traceback(capsys: pytest.CaptureFixture[str]) -> None:
    def interrupted() -> int:
        raise KeyboardInterrupt

    assert exit_status(interrupted) == 1
    assert capsys.readouterr().err == "stopped\n"


def test_file_of_another_user_is_named_without_a_traceback(capsys: pytest.CaptureFixture[str]) -> None:
    def refused() -> int:
        raise PermissionError(13, "Permission denied", "runs/x/config.toml")

    assert exit_status(refused) == 1
    assert capsys.readouterr().err == "daedalus: runs/x/config.toml: Permission denied\n"


def test_a_child_process_that_asks_a_question_gets_no_answer() -> None:
    """Nobody could answer; the end of the parent is noticed as before."""
    program = (
        "import threading\n"
        "from daedalus.cli.processes import exit_with_parent\n"
        "stop = threading.Event()\n"
        "exit_with_parent(stop)\n"
        "try: input()\n"
        "except EOFError: print('no answer', stop.is_set(), flush=True)\n"
        "stop.wait()\n"
    )
    with subprocess.Popen([sys.executable, "-c", program], stdin=subprocess.PIPE, stdout=subprocess.PIPE) as child:
        try:
            assert child.stdin is not None
            assert child.stdout is not None
            assert child.stdout.readline() == b"no answer False\n"
            child.stdin.close()
            assert child.wait(LIMIT) == 0
        finally:
            child.kill()
