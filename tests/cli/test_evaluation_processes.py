"""launch/local_training.py: an evaluator whose process ends without a report."""

import subprocess
import sys
import threading
from pathlib import Path

import pytest
from log_lines import LINES
from saved_runs import CARTPOLE, save

from daedalus.launch.child_output import ChildOutput, Streams
from daedalus.launch.local_run import LocalRun, RunFailedError
from daedalus.launch.local_training import evaluate_run
from daedalus.learner.run.run_directory import write_config, write_json
from daedalus.policy.saving.saved_policy import checkpoints, read_policy


@pytest.mark.parametrize(
    ("program", "how", "reason"),
    [
        ("import os; os._exit(0)", "failed with status 0", r"\(status 0\): play it with `daedalus check`"),
        ("import os; os._exit(7)", "failed with status 7", r"\(status 7\)"),
        ("import os; os.abort()", "was killed by signal 6", r"\(signal 6\)"),
        ("import os; os.kill(os.getpid(), 9)", "was killed by signal 9", "check whether it was for lack of memory"),
    ],
)
def test_an_evaluator_that_ends_without_a_report_is_named_each_time(
    tmp_path: Path, program: str, how: str, reason: str
) -> None:
    def start(module: str, *arguments: str, streams: Streams, one_thread: bool = False) -> subprocess.Popen[bytes]:
        command = [sys.executable, "-S", "-c", program]
        return subprocess.Popen(command, stdin=subprocess.PIPE, stdout=streams.stdout, stderr=streams.stderr)

    run = save(tmp_path / "run", CARTPOLE, 1)
    write_json(run / "summary.json", {})
    spec = read_policy(checkpoints(run)[0]).spec
    write_config(run, spec)
    local_run = LocalRun(directory=run, spec=spec, started=0.0, start_player=start)
    with (
        ChildOutput(tmp_path / "output.log", print, print) as output,
        pytest.raises(RunFailedError, match=reason),
    ):
        evaluate_run(local_run, threading.Event(), output)
    assert LINES == [f"evaluation-0 {how}; started again"] * 2
