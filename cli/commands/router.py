"""`daedalus router`: run a Zenoh router that a learner and its actors connect to."""

import argparse
import logging
import math
import sys
import threading

from daedalus.cli.arguments import add_insecure, add_logging, add_tls, command_parser
from daedalus.launch.logs import configure_logging, print_error
from daedalus.launch.process_lifecycle import (
    exit_status,
    exit_with_parent,
    raise_descriptor_limit,
    status_at_start,
    stop_on_signals,
)
from daedalus.transport.addresses import check_connecting, reachable
from daedalus.transport.connecting import listen
from daedalus.transport.credentials import SECURITY_ERRORS, Credentials, CredentialsError, credentials_to_listen
from daedalus.transport.interface import TransportError
from daedalus.transport.zenoh_session import diagnose_connection
from daedalus.transport.zenoh_settings import MAX_MESSAGE_BYTES
from daedalus.transport.zenoh_transport import ZenohTransport

_logger = logging.getLogger(__name__)

LISTEN = "tcp/127.0.0.1:7447"

_FIRST_LOOK_SECONDS, _LOOK_SECONDS = 3.0, 15.0  # at the connections to other routers
_RETRY_SECONDS = 1.5  # more than Zenoh waits between two attempts

_DESCRIPTION = """\
Forwards the traffic between a learner and its actors. With a router of its own, a learner can restart or move to
another host, and the actors keep the same address. The router stores nothing, so it can restart too. Any other Zenoh
router of the same version works as well, such as zenohd. SIGTERM or Ctrl-C stops it."""

_EXAMPLES = """\
examples:
  daedalus router                                          then: daedalus learner cartpole --connect tcp/127.0.0.1:7447
  daedalus router --listen tcp/0.0.0.0:7447 --insecure     for other hosts, on a trusted network only
  daedalus router --listen tls/0.0.0.0:7447 --tls certs/router     on any network (daedalus certs --help)
  daedalus router --connect tcp/gpu-box:7447               joins another router: actors may use either address

exit status: 0 stopped by a signal, 1 cannot listen at the address, 2 bad usage"""


def parser() -> argparse.ArgumentParser:
    """Return the parser of `daedalus router`."""
    options = command_parser("router", _DESCRIPTION, _EXAMPLES)
    options.add_argument(
        "--listen",
        action="append",
        metavar="tcp/HOST:PORT",
        help=f"address where learner and actors connect (default: {LISTEN}). May be given several times",
    )
    options.add_argument(
        "--connect",
        action="append",
        default=[],
        metavar="tcp/HOST:PORT",
        help="another router to join, now or when it starts. May be given several times",
    )
    options.add_argument(
        "--max-message-megabytes",
        type=_megabytes,
        default=MAX_MESSAGE_BYTES / 2**20,
        metavar="MIB",
        help="largest message that the router forwards; it drops larger ones while they arrive. Raise it for networks "
        "whose snapshots are larger (default: %(default)g)",
    )
    add_tls(options)
    add_insecure(options)
    add_logging(options)
    options.add_argument("--exit-with-parent", action="store_true", help=argparse.SUPPRESS)
    return options


def _megabytes(text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not 1.0 <= value <= 1024.0:
        raise argparse.ArgumentTypeError(f"{text!r} is not a number from 1 to 1024")
    return value


def router(arguments: list[str]) -> int:
    """Run `daedalus router` and return its exit status."""
    parsed = parser().parse_args(arguments)
    configure_logging(parsed.log_level, as_json=parsed.log_json, process="router")
    try:
        if parsed.connect:
            check_connecting(parsed.connect, tls=parsed.tls is not None)
        addresses = parsed.listen or [LISTEN]
        credentials = credentials_to_listen(addresses, parsed.tls, "router", insecure=parsed.insecure)
    except SECURITY_ERRORS as error:
        print_error("router", error)
        return status_at_start(error)
    raise_descriptor_limit()
    stop = stop_on_signals()
    if parsed.exit_with_parent:
        exit_with_parent(stop)
    try:
        hosts = credentials.hosts() if credentials else []
        limit = int(parsed.max_message_megabytes * 2**20)
        transport = listen(addresses, parsed.connect, credentials, max_message_bytes=limit)
    except (TransportError, CredentialsError) as error:
        print_error("router", error)
        return 1
    try:
        if credentials is None:
            _logger.info("listening on %s", " and ".join(reachable(addresses)))
        else:
            _logger.info("listening on %s; the certificate is for %s", " and ".join(addresses), ", ".join(hosts))
        _log_unreached(transport, parsed.connect, credentials, stop)
        stop.wait()
    finally:
        transport.close()
    return 0


def _log_unreached(
    transport: ZenohTransport, others: list[str], credentials: Credentials | None, stop: threading.Event
) -> None:
    """Log which of the other routers cannot be reached and why, until `stop` is set: Zenoh keeps trying in silence."""
    logged, pause = "", _FIRST_LOOK_SECONDS
    while others and not stop.wait(pause):
        reasons = {each: diagnose_connection(each, credentials).reason for each in transport.unreached(others)}
        if reasons and stop.wait(_RETRY_SECONDS):
            return
        still = transport.unreached(list(reasons))  # others were about to be reached
        text = "; ".join(reasons[each] for each in still)
        if text and text != logged:
            _logger.warning("%s; trying again", text)
        elif logged and not text:
            _logger.info("connected to %s", " and ".join(others))
        logged, pause = text, _LOOK_SECONDS


if __name__ == "__main__":
    sys.exit(exit_status(lambda: router(sys.argv[1:])))
