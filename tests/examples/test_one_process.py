"""Test of examples/one_process.py: a learner and an actor in one process."""

import re
import sys
from pathlib import Path

import pytest
from processes import Running

EXAMPLE = Path(__file__).parents[2] / "examples" / "one_process.py"


def test_the_example_learns_cartpole_and_prints_the_mean_return(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("TMPDIR", str(tmp_path))  # the example saves its run in this folder
    running = Running([sys.executable, str(EXAMPLE)], tmp_path)
    try:
        assert running.wait() == 0, running.output
    finally:
        running.end()
    found = re.search(r"^mean return (\d+)$", running.output, re.MULTILINE)
    assert found, running.output
    assert int(found[1]) >= 200
    assert f"is in {tmp_path}" in running.lines[-1]
