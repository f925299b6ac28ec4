"""An exception in any thread of a service ends its process: traceback, status 1, so that a supervisor restarts it.

The kinds of threads are in tests/cli/test_thread_exceptions.py. An actor is in test_refusals.py, where there is a
learner for it.
"""

import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

from faults import Faulty
from processes import LIMIT, Running

Start = Callable[..., Running]


def test_an_exception_in_a_thread_of_the_learner_ends_it(start: Start, address: str, tmp_path: Path) -> None:
    endless = ("--set", "training.stop_when_solved=false", "--env-steps", 10**12)
    intake = "daedalus.learner.serving.rollout_judge:RolloutJudge.read"
    learner = Faulty(tmp_path, "learner", intake, "cartpole", "--listen", address, "--run-dir", "run", *endless)
    actor = start("actor", "--connect", address)
    learner.assert_crashes()
    assert actor.process.poll() is None  # it looks for the learner that a supervisor would restart


def test_a_command_of_one_process_has_the_hook_too(tmp_path: Path) -> None:
    """`router`, `exporter` and `train` run in the process of `daedalus` itself."""
    program = "\n".join(
        [
            "import sys, threading",
            "from daedalus.cli.commands import router",
            "def fail(): raise RuntimeError('a fault of ours')",
            "def run(arguments):",
            "    threading.Thread(target=fail).start()",
            "    threading.Event().wait(600)",
            "router.router = run",
            "sys.argv = ['daedalus', 'router']",
            "from daedalus.cli.main import main",
            "sys.exit(main())",
        ]
    )
    command = [sys.executable, "-P", "-c", program]
    ended = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, timeout=LIMIT, check=False)
    assert ended.returncode == 1
    assert "RuntimeError: a fault of ours" in ended.stderr
