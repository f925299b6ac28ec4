"""The actor's command line."""

import argparse
import os
import re
import secrets
import socket

from daedalus.actor.session.service import ActorConfig
from daedalus.cli.arguments import add_connect, add_tls, command_parser
from daedalus.cli.logs import add_logging
from daedalus.protocol import keys
from daedalus.transport.credentials import Credentials
from daedalus.transport.security import authorization_hint

DESCRIPTION = """\
Plays environments for a learner and streams what happens to it. Needs one address; the environment, the
network and all else come from the learner. May start before it, and join or leave at any time."""

EXAMPLES = """\
examples:
  daedalus actor --connect tcp/127.0.0.1:7447
  daedalus actor --connect tcp/gpu-box:7447 --envs 32 --name arm-3
  daedalus actor --connect tls/gpu-box:7447 --tls actor-arm-3
  daedalus actor --connect tcp/127.0.0.1:7447 --evaluator"""


def parser() -> argparse.ArgumentParser:
    """Parses what `daedalus actor` takes."""
    options = command_parser("actor", DESCRIPTION, EXAMPLES)
    add_connect(options, "where the learner, or a router that knows it, listens")
    options.add_argument(
        "--envs",
        type=int,
        metavar="E",
        help="environments to step together (default: what the learner asks for)",
    )
    options.add_argument(
        "--wrap",
        metavar="MODULE:FUNCTION",
        help="your own transform: takes each gymnasium environment and returns the one to play",
    )
    options.add_argument(
        "--runtime",
        choices=("onnx", "torch"),
        default="onnx",
        help="what runs the policy (default: %(default)s, which needs no torch)",
    )
    options.add_argument(
        "--run", default=keys.ANY_RUN, metavar="NAME", help="which run to join, where several share a network"
    )
    options.add_argument(
        "--name",
        metavar="NAME",
        help="this actor's name, the same after a restart (default: from the host's)",
    )
    options.add_argument(
        "--link",
        choices=("auto", "lan", "wan"),
        default="auto",
        help="wan: fetch weights in bfloat16, as differences, and as often as the link bears, instead of every version "
        "whole (default: %(default)s, measured when joining)",
    )
    options.add_argument(
        "--timeout", type=float, metavar="SECONDS", help="how long to look for a learner (default: for ever)"
    )
    options.add_argument(
        "--evaluator",
        action="store_true",
        help="play greedily on the run's schedule and report, instead of gathering experience",
    )
    add_tls(options)
    add_logging(options)
    options.add_argument("--exit-with-parent", action="store_true", help=argparse.SUPPRESS)
    return options


def config(arguments: argparse.Namespace, credentials: Credentials | None) -> ActorConfig:
    """The checked configuration; raises ValueError with one line that says what is wrong."""
    if arguments.envs is not None and not 1 <= arguments.envs <= 4096:
        raise ValueError(f"--envs must be from 1 to 4096, not {arguments.envs}")
    if arguments.run != keys.ANY_RUN:
        keys.check_name(arguments.run, "run")
    name = arguments.name or (f"{credentials.name}.{os.getpid()}" if credentials else _default_name())
    if credentials and credentials.name not in (name, name.partition(".")[0]):
        raise ValueError(
            f"the certificate in {credentials.directory} is not for {name!r}: "
            f"--name {credentials.name} or {credentials.name}.ANYTHING"
        )
    return ActorConfig(
        name=keys.check_name(name, "actor name"),
        incarnation=secrets.randbits(62),
        run=arguments.run,
        environments=arguments.envs,
        runtime=arguments.runtime,
        wrap=arguments.wrap,
        link=arguments.link,
        authorization_hint=authorization_hint(credentials),
        timeout=arguments.timeout,
    )


def _default_name() -> str:
    host = re.sub(r"[^A-Za-z0-9-]", "-", socket.gethostname()).strip("-") or "actor"
    return f"{host[:40]}-{os.getpid()}"
