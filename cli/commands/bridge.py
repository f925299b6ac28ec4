"""`daedalus bridge`: listen for actors in other languages.

Exit status: 0 stopped by a signal, 1 failed, 2 bad usage.
"""

import argparse
import logging
import socket
import sys

from daedalus.bridge.service import Bridge
from daedalus.cli.arguments import add_connect, add_insecure, add_tls, command_parser
from daedalus.cli.logs import add_logging, configure_logging
from daedalus.cli.processes import exit_on_thread_exceptions, exit_status, raise_descriptor_limit, stop_on_signals
from daedalus.transport.addresses import AddressError, check_listening
from daedalus.transport.connecting import connect
from daedalus.transport.security import SECURITY_ERRORS, credentials_to_connect

_logger = logging.getLogger("daedalus.cli")  # this module is __main__ when it runs

LISTEN = "tcp/127.0.0.1:7448"

DESCRIPTION = """\
Forwards queries, answers, snapshots and presence between plain TCP connections and the network of a run. Actors in
languages without a Zenoh binding connect to it. docs/wire.md describes the protocol, and examples/node is such an
actor. The bridge can use TLS towards the network, with the certificate of an actor. Its clients use no TLS."""

EXAMPLES = """\
examples:
  daedalus bridge --connect tcp/127.0.0.1:7447
  daedalus bridge --connect tls/gpu-box:7447 --tls actor-arm-3 --listen tcp/127.0.0.1:7448

exit status: 0 stopped by a signal, 1 failed, 2 bad usage"""


def parser() -> argparse.ArgumentParser:
    """Return the parser of `daedalus bridge`."""
    options = command_parser("bridge", DESCRIPTION, EXAMPLES)
    add_connect(options, "address of the learner or of its router. May be given several times")
    options.add_argument(
        "--listen", default=LISTEN, metavar="tcp/HOST:PORT", help="address where clients connect (default: %(default)s)"
    )
    add_tls(options)
    add_insecure(options)
    add_logging(options)
    return options


def main() -> int:
    """Run `daedalus bridge` and return its exit status."""
    arguments = parser().parse_args()
    configure_logging(arguments.log_level, as_json=arguments.log_json, prefix="bridge: ")
    try:
        credentials = credentials_to_connect(arguments.connect, arguments.tls, "actor")
        if arguments.listen.startswith("tls/"):
            raise AddressError(f"{arguments.listen}: the clients of a bridge use no TLS, listen on tcp/127.0.0.1:PORT")
        check_listening([arguments.listen], tls=False, insecure=arguments.insecure)
    except SECURITY_ERRORS as error:
        print(f"daedalus bridge: {error}", file=sys.stderr)
        return 2
    raise_descriptor_limit()
    stop = stop_on_signals()
    host, _, port = arguments.listen.partition("/")[2].rpartition(":")
    try:
        listener = socket.create_server((host, int(port)))
    except OSError as error:
        print(f"daedalus bridge: cannot listen on {arguments.listen}: {error.strerror}", file=sys.stderr)
        return 1
    _logger.info("clients connect to tcp/%s:%d", host, listener.getsockname()[1])
    Bridge(listener, lambda: connect(arguments.connect, credentials)).run(stop)
    return 0


if __name__ == "__main__":
    exit_on_thread_exceptions()
    sys.exit(exit_status(main))
