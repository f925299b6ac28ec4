"""cli/main.py: the command that a command line names."""

import subprocess
import sys
from pathlib import Path

import pytest

import daedalus
from daedalus.cli import main


def test_version_is_that_of_the_package(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setattr("sys.argv", ["daedalus", "--version"])
    assert main.main() == 0
    assert capsys.readouterr().out == f"daedalus {daedalus.__version__}\n"


def test_python_m_daedalus_is_daedalus_also_beside_a_file_that_is_named_like_a_module(tmp_path: Path) -> None:
    (tmp_path / "signal.py").write_text("raise SystemExit('imported')")
    for words, status in ((["--version"], 0), (["trian"], 2), (["actor", "--help"], 0)):
        line = [sys.executable, "-m", "daedalus", *words]
        ended = subprocess.run(line, cwd=tmp_path, capture_output=True, text=True, check=False)
        assert ended.returncode == status, ended
        assert "daedalus" in ended.stdout + ended.stderr
