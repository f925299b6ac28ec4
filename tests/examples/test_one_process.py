"""examples/one_process.py: a learner and an actor in one process, as a reader would run them."""

import re
import sys
from pathlib import Path

import pytest
from processes import Running

EXAMPLE = Path(__file__).parents[2] / "examples" / "one_process.py"


def test_it_learns_cartpole_and_says_so(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("TMPDIR", str(tmp_path))  # where it keeps its run
    running = Running([sys.executable, str(EXAMPLE)], tmp_path)
    try:
        assert running.wait() == 0, running.output
    finally:
        running.end()
    found = re.search(r"^mean return (\d+)$", running.output, re.MULTILINE)
    assert found, running.output
    assert int(found[1]) >= 200
    assert f"is in {tmp_path}" in running.lines[-1]
