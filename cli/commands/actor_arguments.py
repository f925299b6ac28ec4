"""The command line of `daedalus actor`."""

import argparse
import secrets

from daedalus.actor.session.actor_config import ActorConfig, own_name
from daedalus.cli.arguments import add_allow_module, add_connect, add_tls, command_parser, seconds
from daedalus.cli.logs import add_logging
from daedalus.policy.user_modules import UserModules
from daedalus.protocol import keys
from daedalus.transport.credentials import Credentials

DESCRIPTION = """\
Plays environments and sends rollouts to a learner. An actor needs one address: the environment, the network and all
settings come from the learner. An actor may start before the learner, and may join or leave at any time."""

EXAMPLES = """\
examples:
  daedalus actor --connect tcp/127.0.0.1:7447
  daedalus actor --connect tcp/gpu-box:7447 --envs 32 --name arm-3
  daedalus actor --connect tls/gpu-box:7447 --tls actor-arm-3
  daedalus actor --connect tcp/gpu-box:7447 --allow-module corridor      (the run plays corridor:Corridor-v0)
  daedalus actor --connect tcp/127.0.0.1:7447 --evaluator
  daedalus actor --connect tcp/router:7447 --stay      (serves one run after another)

exit status: 0 the run is over, the actor was stopped or an operator drained it; 1 failed; 2 bad usage. With --stay an
actor ends by a signal, a drain, wrong arguments or its --timeout; after any other failure it tries again"""


def parser() -> argparse.ArgumentParser:
    """Return the parser of `daedalus actor`."""
    options = command_parser("actor", DESCRIPTION, EXAMPLES)
    add_connect(options, "address of the learner or of its router. May be given several times")
    options.add_argument(
        "--envs",
        type=int,
        metavar="E",
        help="number of environments to step together (default: as the learner asks)",
    )
    add_allow_module(options, "the learner")
    options.add_argument(
        "--runtime",
        choices=("onnx", "torch"),
        default="onnx",
        help="library that runs the policy (default: %(default)s, which needs no torch)",
    )
    _add_connection(options)
    options.add_argument(
        "--evaluator",
        action="store_true",
        help="play the evaluations of the run on its schedule and report the returns, instead of sending rollouts",
    )
    options.add_argument(
        "--stay",
        action="store_true",
        help="wait for the next run when a run is over, and try again after a failure that others may remove, such as "
        "a module that a run needs, instead of ending. `daedalus drain` or a signal ends the actor",
    )
    add_tls(options)
    add_logging(options)
    options.add_argument("--exit-with-parent", action="store_true", help=argparse.SUPPRESS)
    return options


def _add_connection(options: argparse.ArgumentParser) -> None:
    """Add the options about the learner, the name and the link."""
    runs = options.add_mutually_exclusive_group()
    runs.add_argument(
        "--run",
        default=keys.ANY_RUN,
        metavar="NAME",
        help="run to join, if several runs share a network (default: the only run; the actor then stays with this run)",
    )
    runs.add_argument(
        "--any-run", action="store_true", help="change to another run when the learner of the present one has gone"
    )
    options.add_argument(
        "--name",
        metavar="NAME",
        help="name of this actor. Keep it after a restart (default: made from the name of the host)",
    )
    options.add_argument(
        "--link",
        choices=("auto", "lan", "wan"),
        default="auto",
        help="lan: fetch whole snapshots. wan: fetch snapshots as bfloat16 differences, as often as the link "
        "allows (default: %(default)s, which measures the link)",
    )
    options.add_argument(
        "--timeout",
        type=seconds,
        metavar="SECONDS",
        help="time to look for a learner before giving up (default: no limit)",
    )


def config(arguments: argparse.Namespace, credentials: Credentials | None) -> ActorConfig:
    """Return the checked configuration. Raises ValueError with a message of one line."""
    if arguments.envs is not None and not 1 <= arguments.envs <= 4096:
        raise ValueError(f"--envs is {arguments.envs}: choose a number from 1 to 4096")
    if arguments.run != keys.ANY_RUN:
        keys.check_name(arguments.run, "run")
    name = arguments.name or own_name(credentials.name if credentials else "")
    if credentials and credentials.name not in (name, name.partition(".")[0]):
        raise ValueError(
            f"the certificate in {credentials.directory} is not for {name!r}: "
            f"use --name {credentials.name} or {credentials.name}.ANYTHING"
        )
    return ActorConfig(
        name=keys.check_name(name, "actor name"),
        incarnation=secrets.randbits(62),
        run=arguments.run,
        environments=arguments.envs,
        runtime=arguments.runtime,
        modules=UserModules(frozenset(arguments.allow_module), "the learner"),
        link=arguments.link,
        timeout=arguments.timeout,
        any_run=arguments.any_run,
    )
