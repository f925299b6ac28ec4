"""Reference of all commands, generated from the help of their parsers when the site is built.

The marker `<!-- commands -->` in a page is replaced by the help of every command.
"""

import argparse
import os
from typing import Any
from unittest.mock import patch

from daedalus.cli.command_table import COMMANDS

MARKER = "<!-- commands -->"


def on_page_markdown(markdown: str, **_: Any) -> str:
    """Insert the reference where a page has the marker. MkDocs calls this function."""
    return markdown.replace(MARKER, command_sections()) if MARKER in markdown else markdown


def command_sections() -> str:
    """Return the reference as Markdown: a heading and the help text for each command and its verbs."""
    with patch.dict(os.environ, COLUMNS="100", NO_COLOR="1"):
        return "\n\n".join(_section(command.make_parser(), 2) for command in COMMANDS.values())


def _section(parser: argparse.ArgumentParser, level: int) -> str:
    verbs = [
        verb
        for action in parser._actions
        if isinstance(action, argparse._SubParsersAction)
        for verb in action.choices.values()
    ]
    own = f"{'#' * level} {parser.prog}\n\n```text\n{parser.format_help().strip()}\n```"
    return "\n\n".join([own, *(_section(verb, level + 1) for verb in verbs)])
