"""Commands whose standard streams are closed when they start, as by `>&-` of a shell."""

import subprocess
from pathlib import Path

import pytest
from processes import DAEDALUS

CLOSED = {"stdin": "<&-", "stdout": ">&-", "stderr": "2>&-"}


def run(folder: Path, closing: str, *words: str) -> subprocess.CompletedProcess[str]:
    command = ["sh", "-c", f'exec "$@" {closing}', "sh", *DAEDALUS, *words]
    return subprocess.run(command, cwd=folder, capture_output=True, text=True)


@pytest.mark.parametrize("stream", CLOSED)
def test_a_command_runs_without_a_standard_stream(tmp_path: Path, stream: str) -> None:
    result = run(tmp_path, CLOSED[stream], "--version")
    assert (result.returncode, result.stderr) == (0, "")
    assert bool(result.stdout) == (stream != "stdout")


@pytest.mark.parametrize(
    ("words", "status", "message"),
    [
        (("evaluate", "nowhere"), 1, "nowhere does not exist"),
        (("train", "cartpol"), 2, "unknown preset 'cartpol'"),
        (("learner", "cartpol"), 2, "unknown preset 'cartpol'"),
    ],
)
@pytest.mark.parametrize("closing", [">&-", "<&- >&- 2>&-"])
def test_a_command_reports_its_error_as_far_as_it_can(
    tmp_path: Path, words: tuple[str, ...], status: int, message: str, closing: str
) -> None:
    result = run(tmp_path, closing, *words)
    assert result.returncode == status, result.stderr
    assert (message in result.stderr) == ("2>&-" not in closing)
    assert "Traceback" not in result.stderr
    assert result.stdout == ""
    assert not list(tmp_path.iterdir())  # no file has received what was printed
