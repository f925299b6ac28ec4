"""What the command lines of all commands share: how help reads, and the words for who may be talked to."""

import argparse
from pathlib import Path


def command_parser(name: str, description: str, examples: str) -> argparse.ArgumentParser:
    """Parses `daedalus NAME`; its help ends with examples, laid out as they are."""
    return argparse.ArgumentParser(
        prog=f"daedalus {name}",
        description=description,
        epilog=examples,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )


def add_connect(options: argparse._ActionsContainer, help: str) -> None:
    """Adds --connect, which must be given and may be several times."""
    options.add_argument("--connect", required=True, action="append", metavar="tcp/HOST:PORT", help=help)


def add_tls(options: argparse._ActionsContainer) -> None:
    """Adds --tls."""
    options.add_argument(
        "--tls",
        type=Path,
        metavar="DIR",
        help="this one's certificate, for addresses that begin with tls/ (daedalus certs makes them)",
    )


def add_insecure(options: argparse._ActionsContainer) -> None:
    """Adds --insecure, for those that listen."""
    options.add_argument(
        "--insecure",
        action="store_true",
        help="listen beyond this machine although whoever reaches the address may take part, unseen and unchecked",
    )
