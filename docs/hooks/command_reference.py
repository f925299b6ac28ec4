"""Reference of all commands, generated from the help of their parsers when the site is built.

The marker `<!-- commands -->` in a page is replaced by the help of every command.
"""

import argparse
import os
from typing import Any
from unittest.mock import patch

from daedalus.cli.commands import (
    certs,
    check,
    compare,
    completion,
    drain,
    exporter,
    gateway,
    plot,
    push,
    report,
    router,
    status,
    sweep,
    train,
)
from daedalus.cli.commands.actor_arguments import parser as actor_parser
from daedalus.cli.commands.evaluate_arguments import parser as evaluate_parser
from daedalus.cli.settings_arguments import learner_parser

MARKER = "<!-- commands -->"


def parsers() -> dict[str, argparse.ArgumentParser]:
    """Return the parser of every command, in the order of `daedalus --help`."""
    return {
        "train": train.train_parser(),
        "resume": train.resume_parser(),
        "sweep": sweep.parser(),
        "check": check.parser(),
        "learner": learner_parser(),
        "actor": actor_parser(),
        "router": router.parser(),
        "status": status.parser(),
        "drain": drain.parser(),
        "gateway": gateway.parser(),
        "exporter": exporter.parser(),
        "certs": certs.parser(),
        "evaluate": evaluate_parser(),
        "plot": plot.parser(),
        "compare": compare.parser(),
        "report": report.parser(),
        "push": push.parser(),
        "completion": completion.parser(),
    }


def on_page_markdown(markdown: str, **_: Any) -> str:
    """Insert the reference where a page has the marker. MkDocs calls this function."""
    return markdown.replace(MARKER, command_sections()) if MARKER in markdown else markdown


def command_sections() -> str:
    """Return the reference as Markdown: a heading and the help text for each command and its verbs."""
    with patch.dict(os.environ, COLUMNS="100", NO_COLOR="1"):
        return "\n\n".join(_section(parser, 2) for parser in parsers().values())


def _section(parser: argparse.ArgumentParser, level: int) -> str:
    verbs = [
        verb
        for action in parser._actions
        if isinstance(action, argparse._SubParsersAction)
        for verb in action.choices.values()
    ]
    own = f"{'#' * level} {parser.prog}\n\n```text\n{parser.format_help().strip()}\n```"
    return "\n\n".join([own, *(_section(verb, level + 1) for verb in verbs)])
