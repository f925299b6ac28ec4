"""`daedalus exporter`: serve the status of learners as Prometheus metrics over HTTP."""

import argparse
import contextlib
import logging
import threading
from collections.abc import Iterator
from typing import TYPE_CHECKING

from daedalus.cli.arguments import add_connect, add_logging, add_tls, command_parser
from daedalus.launch.logs import configure_logging, print_error
from daedalus.launch.process_lifecycle import status_at_start, stop_on_signals
from daedalus.protocol.codec import ProtocolError
from daedalus.protocol.messages import RunStatus
from daedalus.transport.connecting import connect_with_retry
from daedalus.transport.credentials import SECURITY_ERRORS, Credentials, credentials_to_connect
from daedalus.transport.interface import Transport, TransportError
from daedalus.transport.retries import Retries
from daedalus.transport.slow_calls import SlowCall
from daedalus.transport.status_query import ask

if TYPE_CHECKING:
    from prometheus_client.core import Metric

_logger = logging.getLogger(__name__)

_LISTEN = "127.0.0.1:9464"
_MAX_ACTORS = 1000  # of a run with series of their own
_REOPEN_SECONDS = 10.0  # after this time without an answer, a new session replaces the old one

_DESCRIPTION = """\
Serves the values of `daedalus status` as Prometheus metrics. It queries the learners at each scrape and stores nothing.
It may start before a learner: while no learner answers, daedalus_up is 0. Of a run with more than 1,000 actors, the
first 1,000 by name have series of their own; the metrics of the run are over all. deploy/grafana has a dashboard."""

_EXAMPLES = """\
examples:
  daedalus exporter --connect tcp/127.0.0.1:7447         then: curl http://127.0.0.1:9464/metrics
  daedalus exporter --connect tcp/router:7447 --listen 0.0.0.0:9464

exit status: 0 stopped by a signal, 1 the address is in use or the certificate is not valid now, 2 bad usage"""


def parser() -> argparse.ArgumentParser:
    """Return the parser of `daedalus exporter`."""
    options = command_parser("exporter", _DESCRIPTION, _EXAMPLES)
    add_connect(options, "address of the learner or of its router. May be given several times")
    options.add_argument(
        "--listen",
        default=_LISTEN,
        type=_host_and_port,
        metavar="HOST:PORT",
        help="address that Prometheus scrapes (default: %(default)s)",
    )
    add_tls(options)
    add_logging(options)
    return options


def _host_and_port(text: str) -> tuple[str, int]:
    host, _, port = text.rpartition(":")
    if not host or not port.isdecimal() or int(port) > 65535:
        raise argparse.ArgumentTypeError(f"{text!r} is not HOST:PORT: write for example {_LISTEN}")
    return host.strip("[]"), int(port)


class StatusCollector:
    """Collector that queries the learners at each scrape. The timeout of the query bounds the time of a scrape."""

    def __init__(self) -> None:
        self.transport: Transport | None = None  # None until a router answers
        self.unanswered = False  # whether no learner answered the last scrape
        self._warned = False  # that not all actors have series

    def collect(self) -> Iterator["Metric"]:
        """Query the learners and return their metrics."""
        from daedalus.launch.prometheus_exporter import metrics

        statuses = []
        if self.transport is not None:
            with contextlib.suppress(TransportError, ProtocolError):
                statuses = ask(self.transport, max_actors=_MAX_ACTORS)
        self.unanswered = not statuses
        self._warn_of_large_fleet(statuses)
        return metrics(statuses)

    def _warn_of_large_fleet(self, statuses: list[RunStatus]) -> None:
        """Warn once if not all actors have series of their own."""
        for status in statuses:
            if status.fleet_size > len(status.actors) and not self._warned:
                self._warned = True
                _logger.warning(
                    "run %r has %d actors: %d of them have metrics of their own; those of the run are over all",
                    status.run,
                    status.fleet_size,
                    len(status.actors),
                )

    def describe(self) -> list["Metric"]:
        """Return nothing, so that the registry does not query the learners to find the metrics."""
        return []


def exporter(arguments: list[str]) -> int:
    """Run `daedalus exporter` and return its exit status."""
    parsed = parser().parse_args(arguments)
    try:
        from prometheus_client import CollectorRegistry

        from daedalus.launch.prometheus_exporter import MetricsServer
    except ModuleNotFoundError:
        print_error("exporter", 'prometheus-client is not installed: pip install "daedalus-rl[monitoring]"')
        return 1
    try:
        credentials = credentials_to_connect(parsed.connect, parsed.tls, "operator", "learner", "router")
    except SECURITY_ERRORS as error:
        print_error("exporter", error)
        return status_at_start(error)
    configure_logging(parsed.log_level, as_json=parsed.log_json, process="exporter")
    stop = stop_on_signals()
    collector, registry = StatusCollector(), CollectorRegistry()
    registry.register(collector)
    host, port = parsed.listen
    try:
        server = MetricsServer(host, port, registry)
    except OSError as error:
        print_error("exporter", f"cannot listen on {host}:{port}: {error.strerror}: choose another --listen")
        return 1
    thread = threading.Thread(target=server.serve_forever, name="metrics", daemon=True)
    thread.start()
    _logger.info("serving http://%s:%d/metrics", host, server.server_port)
    try:
        _follow(collector, parsed.connect, credentials, stop)
    finally:
        server.shutdown()
        server.server_close()
        thread.join()
    return 0


def _follow(
    collector: StatusCollector, endpoints: list[str], credentials: Credentials | None, stop: threading.Event
) -> None:
    """Keep the collector connected until a signal."""

    def check() -> None:
        if stop.is_set():
            raise TransportError("stopped")

    retries = Retries(stop)
    while True:
        try:
            transport = connect_with_retry(endpoints, stop, credentials=credentials)
        except TransportError as error:  # a certificate is refused, perhaps until somebody renews one
            if retries.wait(str(error)):
                return
            continue
        if transport is None:
            return
        break
    collector.transport = transport
    try:
        while not stop.wait(_REOPEN_SECONDS):
            if collector.unanswered:
                # Zenoh reconnects by itself, except if the connection died without an error.
                with contextlib.suppress(TransportError):
                    SlowCall(transport.reopen).wait(check)
    finally:
        collector.transport = None
        transport.close()
