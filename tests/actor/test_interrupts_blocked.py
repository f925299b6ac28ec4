"""The first process of an environment that a process starts: multiprocessing starts a process of its own before it."""

import subprocess
import sys

import pytest

PROGRAM = """
import multiprocessing
import signal
from daedalus.actor.environments.environment_processes import _interrupts_blocked

if __name__ == "__main__":
    with _interrupts_blocked():
        process = multiprocessing.get_context("spawn").Process(target=print)
        process.start()
        print(signal.SIGINT in signal.pthread_sigmask(signal.SIG_BLOCK, []))
    process.join()
    print(signal.SIGINT in signal.pthread_sigmask(signal.SIG_BLOCK, []))
"""


@pytest.mark.skipif(sys.platform == "win32", reason="Windows has no such mask")
def test_interrupts_stay_blocked_while_the_first_process_starts() -> None:
    result = subprocess.run([sys.executable, "-c", PROGRAM], capture_output=True, text=True, check=True)
    assert result.stdout.split() == ["True", "False"]
