"""cli/main.py: the command that a command line names."""

import pytest

import daedalus
from daedalus.cli import main


def test_version_is_that_of_the_package(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setattr("sys.argv", ["daedalus", "--version"])
    assert main.main() == 0
    assert capsys.readouterr().out == f"daedalus {daedalus.__version__}\n"
