"""`daedalus exporter`: the status of learners as Prometheus metrics over HTTP."""

import argparse
import contextlib
import sys
import threading
from collections.abc import Iterator
from typing import TYPE_CHECKING

from daedalus.cli.arguments import add_connect, add_tls, command_parser
from daedalus.cli.commands.status import ask
from daedalus.cli.logs import configure_logging
from daedalus.cli.processes import stop_on_signals
from daedalus.protocol.codec import ProtocolError
from daedalus.transport.connecting import connect_with_retry
from daedalus.transport.credentials import Credentials
from daedalus.transport.interface import Transport, TransportError
from daedalus.transport.security import SECURITY_ERRORS, credentials_to_connect

if TYPE_CHECKING:
    from prometheus_client.core import Metric

_LISTEN = "127.0.0.1:9464"
_REOPEN_SECONDS = 10.0  # how often a session that brings no answer is replaced by another

_DESCRIPTION = """\
Serves what `daedalus status` shows as Prometheus metrics: asks the learners at each scrape, remembers nothing. May
start before them; while none answers, daedalus_up is 0. deploy/grafana holds a dashboard for it."""

_EXAMPLES = """\
examples:
  daedalus exporter --connect tcp/127.0.0.1:7447         then: curl http://127.0.0.1:9464/metrics
  daedalus exporter --connect tcp/router:7447 --listen 0.0.0.0:9464

exit status: 0 it was told to stop, 1 it cannot listen there or is not let in, 2 bad usage"""


def parser() -> argparse.ArgumentParser:
    """Parses what `daedalus exporter` takes."""
    options = command_parser("exporter", _DESCRIPTION, _EXAMPLES)
    add_connect(options, "where the learner, or its router, listens")
    options.add_argument(
        "--listen",
        default=_LISTEN,
        type=_host_and_port,
        metavar="HOST:PORT",
        help="where Prometheus scrapes (default: %(default)s)",
    )
    add_tls(options)
    return options


def _host_and_port(text: str) -> tuple[str, int]:
    host, _, port = text.rpartition(":")
    if not host or not port.isdecimal() or int(port) > 65535:
        raise argparse.ArgumentTypeError(f"{text!r} is not HOST:PORT")
    return host.strip("[]"), int(port)


class StatusCollector:
    """Asks the learners whenever it is scraped; what one scrape costs is bounded by the status query's time."""

    def __init__(self) -> None:
        self.transport: Transport | None = None  # once there is a router
        self.unanswered = False  # at the last scrape

    def collect(self) -> Iterator["Metric"]:
        """The metrics as of now."""
        from daedalus.cli.prometheus_metrics import metrics

        statuses = []
        if self.transport is not None:
            with contextlib.suppress(TransportError, ProtocolError):
                statuses = ask(self.transport)
        self.unanswered = not statuses
        return metrics(statuses)

    def describe(self) -> list["Metric"]:
        """Nothing: else the registry would ask the learners to find out."""
        return []


def exporter(arguments: list[str]) -> int:
    """Runs `daedalus exporter`."""
    parsed = parser().parse_args(arguments)
    try:
        from prometheus_client import CollectorRegistry, start_http_server
    except ModuleNotFoundError:
        print('daedalus exporter: needs prometheus-client: pip install "daedalus-rl[monitoring]"', file=sys.stderr)
        return 1
    try:
        credentials = credentials_to_connect(parsed.connect, parsed.tls, "operator", "learner", "router")
    except SECURITY_ERRORS as error:
        print(f"daedalus exporter: {error}", file=sys.stderr)
        return 2
    configure_logging(prefix="exporter: ")
    stop = stop_on_signals()
    collector, registry = StatusCollector(), CollectorRegistry()
    registry.register(collector)
    host, port = parsed.listen
    try:
        server, thread = start_http_server(port, host, registry)
    except OSError as error:
        print(f"daedalus exporter: cannot listen on {host}:{port}: {error.strerror}", file=sys.stderr)
        return 1
    print(f"exporter: http://{host}:{server.server_port}/metrics", flush=True)
    try:
        _follow(collector, parsed.connect, credentials, stop)
    except TransportError as error:  # no waiting mends it
        print(f"daedalus exporter: {error}", file=sys.stderr)
        return 1
    finally:
        server.shutdown()
        server.server_close()
        thread.join()
    return 0


def _follow(
    collector: StatusCollector, endpoints: list[str], credentials: Credentials | None, stop: threading.Event
) -> None:
    """Keeps the collector connected, until told to stop. Raises TransportError if it will never be let in."""

    transport = connect_with_retry(endpoints, stop, credentials=credentials)
    if transport is None:
        return
    collector.transport = transport
    try:
        while not stop.wait(_REOPEN_SECONDS):
            if collector.unanswered:
                # It reconnects by itself, unless the link is dead without a word.
                with contextlib.suppress(TransportError):
                    transport.reopen()
    finally:
        collector.transport = None
        transport.close()
