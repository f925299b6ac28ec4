"""Shared parts of the command lines: the layout of help, and the options for addresses, security and modules."""

import argparse
import math
import re
import shlex
from collections.abc import Sequence
from pathlib import Path
from typing import get_args

from daedalus.launch.logs import LEVELS, LogOptions, print_error
from daedalus.launch.supervision import Inference
from daedalus.policy.user_modules import ModuleNotAllowedError, allow_words


def command_parser(name: str, description: str, examples: str) -> argparse.ArgumentParser:
    """Return the parser of `daedalus NAME`. Its help ends with the examples, printed as they are written."""
    return argparse.ArgumentParser(
        prog=f"daedalus {name}",
        description=description,
        epilog=examples,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )


def add_connect(options: argparse._ActionsContainer, *, required: bool = True) -> None:
    """Add --connect, which may be given several times."""
    options.add_argument(
        "--connect",
        required=required,
        action="append",
        metavar="tcp/HOST:PORT",
        help="address of the learner or of its router. May be given several times",
    )


def add_tls(options: argparse._ActionsContainer) -> None:
    """Add --tls."""
    options.add_argument(
        "--tls",
        type=Path,
        metavar="DIR",
        help="folder with the certificate of this process, for tls/ addresses (see daedalus certs --help)",
    )


def add_reset_statistics(options: argparse._ActionsContainer, only: str = "") -> None:
    """Add --reset-statistics to a parser; `only` says when it may be used."""
    options.add_argument(
        "--reset-statistics",
        action="store_true",
        help=f"{only}forget the sizes of observations and rewards that the checkpoint has, which the next rollouts "
        "then define anew: for a run that a broken sensor has spoiled",
    )


def whole_number(text: str) -> int:
    """Return the number in the word of an option, also of a word such as 1e6. For argparse."""
    try:
        return int(text)
    except ValueError:
        pass
    try:
        number = float(text)
        if number.is_integer():
            return int(number)
    except ValueError:
        pass
    raise argparse.ArgumentTypeError(f"{text!r} is not a whole number")


def seconds(text: str) -> float:
    """Return the duration in the word of an option. For argparse."""
    try:
        duration = float(text)
    except ValueError:
        duration = math.nan
    if not duration >= 0.0:  # NaN is refused, too
        raise argparse.ArgumentTypeError(f"{text!r} is not a number of seconds, 0 or more")
    return duration


def add_insecure(options: argparse._ActionsContainer) -> None:
    """Add --insecure, for commands that listen."""
    options.add_argument(
        "--insecure",
        action="store_true",
        help="allow an address that other hosts can reach without TLS. Every host that reaches it may take part, and "
        "traffic is not encrypted",
    )


def add_inference(options: argparse._ActionsContainer) -> None:
    """Add --inference."""
    options.add_argument(
        "--inference",
        choices=get_args(Inference),
        default="local",
        help="where the policies of the actors run. local: in each actor; shared: in one process for all of them, on "
        "half of the cores; cuda: in one process on the GPU, with torch (default: %(default)s)",
    )


def add_allow_module(options: argparse._ActionsContainer, source: str) -> None:
    """Add --allow-module, which may be given several times; `source` says whose settings name modules."""
    options.add_argument(
        "--allow-module",
        action="append",
        default=[],
        type=_module,
        metavar="NAME",
        help=f"module of your own that {source} may name and this command then imports. Importing a module runs it. "
        "May be given several times",
    )


def allowing(error: ModuleNotAllowedError, command: Sequence[str]) -> str:
    """Return a message with the command line to type, if the user trusts the modules."""
    return f"{error.reason}; if you trust that code, type: {shlex.join([*command, *allow_words(error.modules)])}"


def print_policy_error(command: str, error: Exception, arguments: Sequence[str]) -> int:
    """Print why a command cannot use a policy, and how to allow its modules; return the exit status."""
    refused = error.__cause__ if isinstance(error.__cause__, ModuleNotAllowedError) else None
    print_error(command, allowing(refused, ["daedalus", command, *arguments]) if refused else error)
    return 2 if refused else 1


def _module(name: str) -> str:
    if re.fullmatch(r"\w+(\.\w+)*", name) is None or name.endswith(".py"):
        raise argparse.ArgumentTypeError(f"{name!r} is not the name of a module: write my_module, without :NAME or .py")
    return name


def add_logging(options: argparse._ActionsContainer) -> None:
    """Add --log-level and --log-json."""
    options.add_argument(
        "--log-level",
        choices=LEVELS,
        default="info",
        help="lowest severity of log records shown (default: %(default)s)",
    )
    options.add_argument("--log-json", action="store_true", help="write log records as JSON, one object per line")


def log_options(arguments: argparse.Namespace) -> LogOptions:
    """Return what the options of `add_logging` choose."""
    return LogOptions(level=arguments.log_level, as_json=arguments.log_json)
