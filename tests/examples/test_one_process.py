"""Test of examples/one_process.py: a learner and an actor in one process."""

import importlib
import re
import tempfile
from pathlib import Path

import pytest

EXAMPLES = Path(__file__).parents[2] / "examples"


def test_the_example_learns_cartpole_and_prints_the_mean_return(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))  # the example saves its run in this folder
    monkeypatch.syspath_prepend(str(EXAMPLES))
    importlib.import_module("one_process").main()
    printed = capsys.readouterr().out
    found = re.search(r"^mean return (\d+)$", printed, re.MULTILINE)
    assert found, printed
    assert int(found[1]) >= 200
    assert f"is in {tmp_path}" in printed.splitlines()[-1]
