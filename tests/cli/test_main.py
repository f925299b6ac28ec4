"""cli/main.py: the command that a command line names; and words of options that are refused, with their errors."""

import argparse
import gc
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

import daedalus
from daedalus.cli import main
from daedalus.cli.commands import actor, orders, router
from daedalus.launch.process_lifecycle import exit_status


def test_version_is_that_of_the_package(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setattr("sys.argv", ["daedalus", "--version"])
    assert main.main() == 0
    assert capsys.readouterr().out == f"daedalus {daedalus.__version__}\n"


def test_python_m_daedalus_is_daedalus_also_beside_a_file_that_is_named_like_a_module(tmp_path: Path) -> None:
    (tmp_path / "signal.py").write_text("raise SystemExit('imported')")
    for words, status, printed in (
        (["--version"], 0, "daedalus "),
        (["trian"], 2, "daedalus: unknown command 'trian': did you mean train?\n"),
        (["actor", "--help"], 0, "usage: daedalus actor "),
    ):
        line = [sys.executable, "-m", "daedalus", *words]
        ended = subprocess.run(line, cwd=tmp_path, capture_output=True, text=True, check=False)
        assert ended.returncode == status, ended
        assert (ended.stdout + ended.stderr).startswith(printed)


def test_the_garbage_collector_that_imports_do_without_is_on_while_a_command_runs(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def state(*_arguments: object) -> int:
        return 7 if gc.isenabled() else 1

    monkeypatch.setattr("sys.argv", ["daedalus", "router"])
    monkeypatch.setattr(main, "exit_on_thread_exceptions", lambda: None)
    monkeypatch.setattr(router, "router", state)
    assert main.main() == 7
    gc.disable()  # as in `python -m daedalus.cli.commands.actor`
    assert exit_status(state) == 7


@pytest.mark.parametrize("parser", [actor.parser, orders.drain_parser])
@pytest.mark.parametrize("text", ["nan", "-1", "-inf", "soon", ""])
def test_a_timeout_that_is_no_duration_is_refused(
    parser: Callable[[], argparse.ArgumentParser], text: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit):
        parser().parse_args(["--connect", "tcp/127.0.0.1:1", f"--timeout={text}"])
    assert f"argument --timeout: {text!r} is not a number of seconds, 0 or more" in capsys.readouterr().err


@pytest.mark.parametrize("text", ["x", "", "nan", "0.5", "2000"])
def test_a_message_size_that_is_no_number_is_refused(text: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        router.parser().parse_args([f"--max-message-megabytes={text}"])
    assert f"argument --max-message-megabytes: {text!r} is not a number from 1 to 1024" in capsys.readouterr().err
