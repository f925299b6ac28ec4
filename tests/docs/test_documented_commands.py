"""Every `daedalus ...` in the documentation is a command line that the command would take."""

import argparse
import re
import shlex
from collections.abc import Sequence
from pathlib import Path

import pytest
from pages import PAGES, ROOT, code_blocks, inline_code, name_of

from daedalus.cli.command_table import COMMANDS
from daedalus.cli.commands import actor, evaluate
from daedalus.cli.settings_arguments import run_choice
from daedalus.learner.run.settings import SettingsError
from daedalus.transport.addresses import AddressError, check_listening


def commands_in_blocks(text: str) -> list[list[str]]:
    """Return the words after `daedalus` of each command line in a page's blocks."""
    blocks = [block.replace("\\\n", " ") for block in code_blocks(text)]
    lines = [re.sub(r"\s#\s.*", "", line) for block in blocks for line in block.splitlines()]
    lines += [line for block in code_blocks(text, "text") for line in examples_of(block)]
    return [
        shlex.split(command)
        for line in lines
        for part in re.split(r"&&|\|\||\s>\s", line)
        for command in re.findall(r"(?<![`\w./'-])daedalus (?=[a-z])(.*)", part)
    ]


def examples_of(help_text: str) -> list[str]:
    """Return the command lines in the examples of a command's help, without the remarks behind them."""
    lines = [line.strip() for line in help_text.splitlines() if line.startswith("  daedalus ")]
    return [re.sub(r"\s{2,}.*", "", line) for line in lines]


def commands_in_sentences(text: str) -> list[list[str]]:
    """Return the words after `daedalus` of each command in a page's sentences."""
    commands = [code.removeprefix("daedalus ") for code in inline_code(text) if re.match(r"daedalus [a-z]", code)]
    return [shlex.split(line) for command in commands for line in alternatives(command)]


def alternatives(command: str) -> list[str]:
    """Return `a [b | c] d` as `a b d` and `a c d`."""
    choice = re.search(r"\[(-[^]]*)\]", command)
    if choice is None:
        return [command]
    return [command.replace(choice[0], option) for option in choice[1].split("|")]


_Verbs = argparse._SubParsersAction


def parse(words: Sequence[str], *, whole: bool) -> argparse.Namespace:
    """Return the parsed command line. Unless it is `whole`, it may lack required arguments."""
    command, *arguments = words
    assert command in COMMANDS, f"`daedalus {command}`: there is no such command"
    parser = COMMANDS[command].make_parser()
    verbs = [each for action in parser._actions if isinstance(action, _Verbs) for each in action.choices.values()]
    for part in [parser, *verbs] if not whole else []:
        for action in part._actions:
            action.required = False
        for group in part._mutually_exclusive_groups:
            group.required = False
    return parser.parse_args(arguments)


def check(words: Sequence[str], *, whole: bool = True) -> None:
    """Fail if `daedalus WORDS` would be refused."""
    command = words[0]
    try:
        parsed = parse(words, whole=whole)
        if command in ("train", "learner") and (parsed.preset or parsed.env):
            if not (parsed.preset or "").endswith(".toml"):  # a file of the reader's
                run_choice(parsed).spec()
            check_listening(parsed.listen or [], tls=parsed.tls is not None, insecure=parsed.insecure)
        if command == "actor" and whole:
            actor.actor_options(parsed).config(None)
        if command == "evaluate" and whole and not parsed.render:
            evaluate.evaluation_options(parsed)
    except (SettingsError, AddressError, ValueError) as error:
        pytest.fail(f"`daedalus {' '.join(words)}` is refused: {error}")
    except SystemExit as end:
        if end.code:
            pytest.fail(f"`daedalus {' '.join(words)}` is refused")


@pytest.mark.parametrize("page", PAGES, ids=name_of)
def test_commands_are_ones_that_we_take(page: Path) -> None:
    text = page.read_text("utf-8")
    for words in commands_in_blocks(text):
        check(words)
    for words in commands_in_sentences(text):
        check(words, whole=False)


def test_the_pages_show_every_command() -> None:
    shown = {words[0] for page in PAGES for words in commands_in_blocks(page.read_text("utf-8"))}
    assert shown == COMMANDS.keys()


def test_a_wrong_command_is_noticed() -> None:
    for line in ("train cartpol", "train cartpole --set training.rate=1", "status", "plot runs/mine --colour red"):
        with pytest.raises(pytest.fail.Exception):
            check(line.split())
    with pytest.raises(pytest.fail.Exception):
        check(["status", "--yaml"], whole=False)


def test_make_targets_and_benchmarks_exist() -> None:
    text = "\n".join(page.read_text("utf-8") for page in PAGES)
    targets = re.findall(r"^([\w-]+):", (ROOT / "Makefile").read_text(), re.MULTILINE)
    named = {code.split()[1] for code in inline_code(text) if re.match(r"make [a-z]", code)}
    assert {"docs", "examples"} <= named <= set(targets)
    for module in re.findall(r"python -m benchmarks\.(\w+)", text):
        assert (ROOT / "benchmarks" / f"{module}.py").exists() or (ROOT / "benchmarks" / module).is_dir(), module
