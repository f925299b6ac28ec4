"""Test of `daedalus completion`: bash itself runs the script."""

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from processes import here

from daedalus.cli.command_table import COMMANDS
from daedalus.cli.commands.completion import command_tree, completion
from daedalus.learner.run.settings import preset_names

BASH = shutil.which("bash")
needs_bash = pytest.mark.skipif(BASH is None, reason="bash is not installed")


@pytest.fixture(scope="module")
def script(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The script that the command prints; as a process it is in test_unread_output.py."""
    path = tmp_path_factory.mktemp("completion") / "daedalus"
    path.write_text("\n".join(here("completion", "bash").lines) + "\n")
    return path


def completed(script: Path, line: str) -> set[str]:
    """Return what bash offers for the last word of a line when Tab is pressed."""
    program = (
        'source "$1"; shift; COMP_WORDS=("$@"); COMP_CWORD=$(($# - 1)); COMP_LINE="$*"; COMP_POINT=${#COMP_LINE}\n'
        "function=$(complete -p daedalus | sed 's/.*-F \\([^ ]*\\).*/\\1/')\n"
        '"$function" daedalus "${COMP_WORDS[COMP_CWORD]}" "${COMP_WORDS[COMP_CWORD-1]}"\n'
        "printf '%s\\n' \"${COMPREPLY[@]}\""
    )
    assert BASH is not None
    words = [BASH, "--norc", "-c", program, "bash", str(script), *line.split(" ")]
    result = subprocess.run(words, capture_output=True, text=True, check=True, env={**os.environ, "LC_ALL": "C"})
    return set(result.stdout.split())


@needs_bash
def test_the_script_is_valid_bash(script: Path) -> None:
    assert BASH is not None
    subprocess.run([BASH, "-n", str(script)], check=True)


@needs_bash
@pytest.mark.parametrize(
    ("line", "expected"),
    [
        ("daedalus tra", {"train"}),
        ("daedalus e", {"evaluate", "export", "exporter"}),
        ("daedalus train --alg", {"--algorithm"}),
        ("daedalus train --algorithm im", {"impala"}),
        ("daedalus train cartp", {name for name in preset_names() if name.startswith("cartp")}),
        ("daedalus learner pon", {"pong"}),
        ("daedalus train cartpole --see", {"--seed"}),
        ("daedalus certs is", {"issue"}),
        ("daedalus certs issue ac", {"actor"}),
        ("daedalus evaluate --act", {"--actions"}),
        ("daedalus completion z", {"zsh"}),
    ],
)
def test_bash_completes_commands_options_and_values(script: Path, line: str, expected: set[str]) -> None:
    assert completed(script, line) == expected


@needs_bash
def test_bash_completes_run_directories(script: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "run-a").mkdir()
    (tmp_path / "run-b.txt").touch()
    assert completed(script, "daedalus evaluate run") == {"run-a"}


@pytest.mark.parametrize("shell", ["bash", "zsh", "tcsh"])
def test_a_script_for_each_shell_names_every_command(shell: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert completion([shell]) == 0
    output = capsys.readouterr().out
    assert set(re.findall(r"[\w-]+", output)) >= COMMANDS.keys()


def test_hidden_options_are_not_completed(script: Path) -> None:
    assert "--exit-with-parent" not in script.read_text()
    assert "--prepared" not in script.read_text()


def test_the_tree_describes_each_command() -> None:
    text = command_tree().format_help()
    assert "Starts a learner and actors as processes of this machine" in " ".join(text.split())


def test_another_command_does_not_load_the_completion() -> None:
    program = "import sys, daedalus.cli.commands.train; print('shtab' in sys.modules)"
    result = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert result.stdout == "False\n"
