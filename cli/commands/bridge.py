"""`daedalus bridge`: listens for clients in other languages.

Exit status: 0 told to stop, 1 failed, 2 bad usage.
"""

import argparse
import logging
import socket
import sys

from daedalus.bridge.service import Bridge
from daedalus.cli.arguments import add_connect, add_insecure, add_tls, command_parser
from daedalus.cli.logs import add_logging, configure_logging
from daedalus.cli.processes import exit_on_thread_exceptions, stop_on_signals
from daedalus.transport.addresses import AddressError, check_listening
from daedalus.transport.security import SECURITY_ERRORS, credentials_to_connect
from daedalus.transport.zenoh_transport import connect

_logger = logging.getLogger("daedalus.cli")  # this module is __main__ when it runs

LISTEN = "tcp/127.0.0.1:7448"

DESCRIPTION = """\
Carries queries, answers, snapshots and presence between a plain TCP connection and the network of a run, for actors
in languages without a Zenoh binding. docs/wire.md says what it speaks; examples/node is such an actor. With an actor's
certificate it reaches a network over TLS; its clients always come in the clear."""

EXAMPLES = """\
examples:
  daedalus bridge --connect tcp/127.0.0.1:7447
  daedalus bridge --connect tls/gpu-box:7447 --tls actor-arm-3 --listen tcp/127.0.0.1:7448"""


def parser() -> argparse.ArgumentParser:
    """Return the parser of `daedalus bridge`."""
    options = command_parser("bridge", DESCRIPTION, EXAMPLES)
    add_connect(options, "where the learner, or a router that knows it, listens")
    options.add_argument(
        "--listen", default=LISTEN, metavar="tcp/HOST:PORT", help="where clients connect (default: %(default)s)"
    )
    add_tls(options)
    add_insecure(options)
    add_logging(options)
    return options


def main() -> int:
    """Runs `daedalus bridge`."""
    arguments = parser().parse_args()
    configure_logging(arguments.log_level, as_json=arguments.log_json, prefix="bridge: ")
    try:
        credentials = credentials_to_connect(arguments.connect, arguments.tls, "actor")
        if arguments.listen.startswith("tls/"):
            raise AddressError(
                f"{arguments.listen}: clients come to a bridge in the clear, listen on tcp/127.0.0.1:PORT"
            )
        check_listening([arguments.listen], tls=False, insecure=arguments.insecure)
    except SECURITY_ERRORS as error:
        print(f"daedalus bridge: {error}", file=sys.stderr)
        return 2
    stop = stop_on_signals()
    host, _, port = arguments.listen.partition("/")[2].rpartition(":")
    try:
        listener = socket.create_server((host, int(port)))
    except OSError as error:
        print(f"daedalus bridge: cannot listen on {arguments.listen}: {error.strerror}", file=sys.stderr)
        return 1
    _logger.info(f"clients connect to tcp/{host}:{listener.getsockname()[1]}")
    Bridge(listener, lambda: connect(arguments.connect, credentials)).run(stop)
    return 0


if __name__ == "__main__":
    exit_on_thread_exceptions()
    sys.exit(main())
