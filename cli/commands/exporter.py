"""`daedalus exporter`: serve the status of learners as Prometheus metrics over HTTP."""

import argparse

from daedalus.cli.arguments import add_connect, add_logging, add_tls, command_parser, log_options
from daedalus.launch.logs import print_error
from daedalus.launch.process_lifecycle import status_at_start, stop_on_signals
from daedalus.transport.credentials import SECURITY_ERRORS, credentials_to_connect

_LISTEN = "127.0.0.1:9464"

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
    add_connect(options)
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


def exporter(arguments: list[str]) -> int:
    """Run `daedalus exporter` and return its exit status."""
    parsed = parser().parse_args(arguments)
    try:
        from daedalus.launch.prometheus_exporter import serve_metrics
    except ModuleNotFoundError:
        print_error("exporter", 'prometheus-client is not installed: pip install "daedalus-rl[monitoring]"')
        return 1
    try:
        credentials = credentials_to_connect(parsed.connect, parsed.tls, "operator", "learner", "router")
    except SECURITY_ERRORS as error:
        print_error("exporter", error)
        return status_at_start(error)
    log_options(parsed).configure(process="exporter")
    return serve_metrics(parsed.listen, parsed.connect, credentials, stop_on_signals())
