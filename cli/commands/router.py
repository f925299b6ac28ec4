"""`daedalus router`: a Zenoh router on its own, which learner and actors meet at."""

import argparse
import sys

from daedalus.cli.arguments import add_insecure, add_tls, command_parser
from daedalus.cli.processes import stop_on_signals
from daedalus.cli.settings_arguments import LISTEN
from daedalus.transport.addresses import check_connecting
from daedalus.transport.credentials import CredentialsError
from daedalus.transport.interface import TransportError
from daedalus.transport.security import SECURITY_ERRORS, credentials_to_listen
from daedalus.transport.zenoh_transport import listen

_DESCRIPTION = """\
Carries the traffic between a learner and its actors, in a process of its own: a learner that is restarted, or moved
to another host, keeps its address. It holds no state, so it can be restarted too. Any other Zenoh router of the same
version, such as zenohd, does as well. Stops at SIGTERM or Ctrl-C."""

_EXAMPLES = """\
examples:
  daedalus router                                          then: daedalus learner cartpole --connect tcp/127.0.0.1:7447
  daedalus router --listen tcp/0.0.0.0:7447 --insecure     other hosts may come: on a trusted network only
  daedalus router --listen tls/0.0.0.0:7447 --tls certs/router     on any network (daedalus certs --help)
  daedalus router --connect tcp/gpu-box:7447               joins another router; actors here need this one's address

exit status: 0 it was told to stop, 1 it cannot listen there, 2 bad usage"""


def parser() -> argparse.ArgumentParser:
    """Parses what `daedalus router` takes."""
    options = command_parser("router", _DESCRIPTION, _EXAMPLES)
    options.add_argument(
        "--listen",
        default=LISTEN,
        metavar="tcp/HOST:PORT",
        help="where learner and actors connect (default: %(default)s)",
    )
    options.add_argument(
        "--connect",
        action="append",
        default=[],
        metavar="tcp/HOST:PORT",
        help="another router to join, now or as soon as it is there; may be given several times",
    )
    add_tls(options)
    add_insecure(options)
    return options


def router(arguments: list[str]) -> int:
    """Runs `daedalus router`."""
    parsed = parser().parse_args(arguments)
    try:
        if parsed.connect:
            check_connecting(parsed.connect, tls=parsed.tls is not None)
        credentials = credentials_to_listen([parsed.listen], parsed.tls, "router", insecure=parsed.insecure)
    except SECURITY_ERRORS as error:
        print(f"daedalus router: {error}", file=sys.stderr)
        return 2
    stop = stop_on_signals()
    try:
        transport = listen([parsed.listen], parsed.connect, credentials)
    except (TransportError, CredentialsError) as error:
        print(f"daedalus router: {error}", file=sys.stderr)
        return 1
    try:
        print(f"router: listening on {parsed.listen}", flush=True)
        stop.wait()
    finally:
        transport.close()
    return 0
