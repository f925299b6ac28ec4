"""launch/final_evaluation.py: an evaluation whose process ends without a result."""

import subprocess
import sys
import threading
from pathlib import Path

import pytest

from daedalus.launch.child_output import ChildOutput, Streams
from daedalus.launch.final_evaluation import EvaluationFailedError, play


@pytest.mark.parametrize(
    ("program", "reason"),
    [
        ("import os; os._exit(0)", r"ended an evaluation \(status 0\): play it with `daedalus check`"),
        ("import os; os._exit(1)", r"ended an evaluation \(status 1\)"),
        ("import os; os._exit(7)", r"ended an evaluation \(status 7\)"),
        ("import os; os.abort()", r"ended an evaluation \(signal 6\)"),
        ("import os; os.kill(os.getpid(), 9)", r"was killed \(signal 9\): check whether .* lack of memory"),
    ],
)
def test_a_process_that_ends_without_a_result_is_named(tmp_path: Path, program: str, reason: str) -> None:
    def start(module: str, *arguments: str, streams: Streams, one_thread: bool = False) -> subprocess.Popen[bytes]:
        command = [sys.executable, "-S", "-c", program]
        return subprocess.Popen(command, stdin=subprocess.PIPE, stdout=streams.stdout, stderr=streams.stderr)

    output = ChildOutput(tmp_path / "output.log", print, print)
    with pytest.raises(EvaluationFailedError, match=reason):
        play([["RUN_DIR"]], threading.Event(), output, start)
