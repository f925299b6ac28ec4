"""launch/process_lifecycle.py: limits and the end of a process."""

import resource
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from processes import LIMIT

from daedalus.launch.process_lifecycle import exit_status, raise_descriptor_limit


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
        "from daedalus.launch.process_lifecycle import exit_with_parent\n"
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


def ended(program: str, folder: Path) -> subprocess.CompletedProcess[str]:
    """Return how a program ended by itself."""
    command = [sys.executable, "-c", program]
    return subprocess.run(command, cwd=folder, capture_output=True, text=True, timeout=LIMIT, check=False)


def test_a_thread_of_an_environment_does_not_hold_up_the_end(tmp_path: Path) -> None:
    (tmp_path / "simulator.py").write_text(
        "import threading, time\ndef connect(): threading.Thread(target=time.sleep, args=(3600,)).start()\n"
    )
    done = ended(
        "import sys\n"
        "from daedalus.launch.process_lifecycle import exit_status\n"
        "def command():\n"
        "    import simulator\n"
        "    simulator.connect()\n"
        "    print('the result')\n"
        "    return 3\n"
        "sys.exit(exit_status(command))\n",
        tmp_path,
    )
    assert (done.returncode, done.stdout) == (3, "the result\n")


def test_an_exception_in_a_thread_of_an_environment_ends_only_the_thread(tmp_path: Path) -> None:
    (tmp_path / "simulator.py").write_text("def listen(): raise TimeoutError('the link is lost')\n")
    done = ended(
        "import threading, simulator\n"
        "from daedalus.launch.process_lifecycle import exit_on_thread_exceptions\n"
        "exit_on_thread_exceptions(plays=True)\n"
        "thread = threading.Thread(target=simulator.listen)\n"
        "thread.start()\n"
        "thread.join()\n"
        "print('it goes on')\n",
        tmp_path,
    )
    assert (done.returncode, done.stdout) == (0, "it goes on\n")
    assert "TimeoutError: the link is lost" in done.stderr


def test_a_fork_of_an_environment_ends_at_a_signal(tmp_path: Path) -> None:
    """The interpreter would wait for ever for a process that ignores SIGTERM."""
    done = ended(
        "import os, signal, time\n"
        "from daedalus.launch.process_lifecycle import stop_on_signals\n"
        "stop_on_signals()\n"
        "begun, begins = os.pipe()\n"
        "child = os.fork()\n"
        "if not child:\n"
        "    os.write(begins, b'.')\n"
        "    time.sleep(3600)\n"
        "os.read(begun, 1)\n"
        "os.kill(child, signal.SIGTERM)\n"
        "print(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]))\n",
        tmp_path,
    )
    assert done.stdout == "-15\n", done.stderr
