"""Shared parts of the command lines: the layout of help, and the options --connect, --tls and --insecure."""

import argparse
from pathlib import Path


def command_parser(name: str, description: str, examples: str) -> argparse.ArgumentParser:
    """Return the parser of `daedalus NAME`. Its help ends with the examples, printed as they are written."""
    return argparse.ArgumentParser(
        prog=f"daedalus {name}",
        description=description,
        epilog=examples,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )


def add_connect(options: argparse._ActionsContainer, help: str, *, required: bool = True) -> None:
    """Add --connect, which may be given several times."""
    options.add_argument("--connect", required=required, action="append", metavar="tcp/HOST:PORT", help=help)


def add_tls(options: argparse._ActionsContainer) -> None:
    """Add --tls."""
    options.add_argument(
        "--tls",
        type=Path,
        metavar="DIR",
        help="folder with the certificate of this process, for tls/ addresses (see daedalus certs --help)",
    )


def add_insecure(options: argparse._ActionsContainer) -> None:
    """Add --insecure, for commands that listen."""
    options.add_argument(
        "--insecure",
        action="store_true",
        help="allow an address that other hosts can reach without TLS. Every host that reaches it may take part, and "
        "traffic is not encrypted",
    )
