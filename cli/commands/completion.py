"""`daedalus completion`: print a script that completes the command line of `daedalus` in a shell."""

import argparse
from pathlib import Path

import shtab

from daedalus.cli.arguments import command_parser
from daedalus.cli.command_table import COMMANDS
from daedalus.learner.reporting.trackers.tracker import TRACKERS
from daedalus.learner.run.settings import preset_names
from daedalus.protocol.algorithms import ALGORITHMS

_DESCRIPTION = "Prints a script that completes commands, options and presets in your shell."

_EXAMPLES = """\
examples:
  daedalus completion bash > ~/.local/share/bash-completion/completions/daedalus
  daedalus completion zsh > ~/.zfunc/_daedalus      (with fpath+=~/.zfunc before compinit in ~/.zshrc)
  daedalus completion tcsh > ~/.daedalus.completion.csh      (source it in ~/.tcshrc)"""


def parser() -> argparse.ArgumentParser:
    """Return the parser of `daedalus completion`."""
    options = command_parser("completion", _DESCRIPTION, _EXAMPLES)
    options.add_argument("shell", choices=shtab.SUPPORTED_SHELLS, help="the shell that reads the script")
    return options


def completion(arguments: list[str]) -> int:
    """Run `daedalus completion` and return its exit status."""
    parsed = parser().parse_args(arguments)
    print(shtab.complete(command_tree(), parsed.shell))
    return 0


def command_tree() -> argparse.ArgumentParser:
    """Return one parser of all commands, for completion only: its choices are not those of the commands."""
    root = argparse.ArgumentParser(prog="daedalus")
    commands = root.add_subparsers(metavar="COMMAND")
    for name, entry in COMMANDS.items():
        command = entry.make_parser()
        summary = " ".join((command.description or "").split()).partition(". ")[0].removesuffix(".")
        tree = commands.add_parser(name, parents=[command], add_help=False, help=summary)
        for action in tree._actions:
            _complete(action)
    return root


def _complete(action: argparse.Action) -> None:
    """Set the words or files that complete an argument. The command itself also accepts other values."""
    if action.dest == "preset":
        action.choices = preset_names()
    elif action.dest == "algorithm":
        action.choices = tuple(ALGORITHMS)
    elif action.dest == "log":
        action.choices = TRACKERS
    elif action.type is Path:
        folder = action.metavar in ("DIR", "RUN_DIR")
        vars(action)["complete"] = shtab.DIRECTORY if folder else shtab.FILE
