"""`daedalus gateway`: actors in any language, over WebSockets, and the page of a run.

Exit status: 0 stopped by a signal, 1 failed, 2 bad usage.
"""

import argparse
import re
import sys
from pathlib import Path

from daedalus.cli.arguments import (
    add_allow_module,
    add_connect,
    add_insecure,
    add_logging,
    add_tls,
    command_parser,
    log_options,
)
from daedalus.launch.gateway_process import LISTEN, GatewayOptions, run_gateway
from daedalus.launch.process_lifecycle import (
    exit_on_thread_exceptions,
    exit_status,
    exit_with_parent,
    raise_descriptor_limit,
    stop_on_signals,
)
from daedalus.protocol import keys

DESCRIPTION = """\
Lets programs in any language be actors, over a WebSocket: they send observations and rewards, and the gateway runs the
policy, collects the rollouts and sends them to the learner. On loopback every user of the machine may connect; any
other address needs --serve-tls, and each client a token. Its page shows the run live in a browser."""

EXAMPLES = """\
examples:
  daedalus gateway --connect tcp/127.0.0.1:7447
  daedalus certs issue gateway --host play.example
  daedalus certs issue client phone-1
  daedalus gateway --connect tcp/127.0.0.1:7447 --listen 0.0.0.0:8443 --serve-tls certs/gateway
  daedalus certs issue actor gateway        (makes certs/actor-gateway)
  daedalus gateway --connect tls/gpu-box:7447 --tls certs/actor-gateway --operator certs/operator
  daedalus gateway --connect tcp/127.0.0.1:7447 --compare runs/cartpole-a2c-s1 runs/cartpole-appo-s1

exit status: 0 stopped by a signal, 1 failed, 2 bad usage"""


def parser() -> argparse.ArgumentParser:
    """Return the parser of `daedalus gateway`."""
    options = command_parser("gateway", DESCRIPTION, EXAMPLES)
    add_connect(options)
    options.add_argument(
        "--run", default=keys.ANY_RUN, metavar="NAME", help="run to follow, if several runs share a network"
    )
    _add_serving(options)
    _add_page(options)
    add_allow_module(options, "the run")
    add_tls(options)
    add_insecure(options)
    add_logging(options)
    options.add_argument("--exit-with-parent", action="store_true", help=argparse.SUPPRESS)
    options.add_argument("--or-any-port", action="store_true", help=argparse.SUPPRESS)
    options.add_argument("--page-only", action="store_true", help=argparse.SUPPRESS)
    return options


def _add_serving(options: argparse.ArgumentParser) -> None:
    """Add the options about who may connect, and where."""
    options.add_argument(
        "--listen", default=LISTEN, metavar="HOST:PORT", help="address where clients connect (default: %(default)s)"
    )
    options.add_argument(
        "--serve-tls",
        type=Path,
        metavar="DIR",
        help="folder of the gateway's certificate and of its clients' tokens (daedalus certs issue gateway)",
    )
    options.add_argument(
        "--host",
        action="append",
        default=[],
        metavar="NAME",
        help="further name or address under which clients reach this gateway. May be given several times",
    )
    options.add_argument(
        "--allow-origin",
        action="append",
        default=[],
        type=_origin,
        metavar="URL",
        help="web site whose pages may connect, such as http://localhost:3000. May be given several times",
    )
    options.add_argument(
        "--record",
        default="",
        metavar="DATASET",
        help="new Minari dataset of the episodes that clients play, with the actions of people: see daedalus record",
    )


def _add_page(options: argparse.ArgumentParser) -> None:
    """Add the options of the page."""
    options.add_argument(
        "--compare",
        nargs="+",
        action="extend",
        default=[],
        type=Path,
        metavar="RUN_DIR",
        help="run directories whose curves the page shows beside those of the run",
    )
    options.add_argument(
        "--operator-token",
        type=Path,
        metavar="FILE",
        help="file with the token that the page asks for; it is written if it is missing. Without it the page is "
        "read-only, and shows only what every user of this machine may ask the learner. With --serve-tls, operators "
        "have the tokens of `daedalus certs`",
    )
    options.add_argument(
        "--operator",
        type=Path,
        metavar="DIR",
        help="folder of an operator's certificate, with which the page reads the status (with --tls)",
    )
    options.add_argument("--no-camera", action="store_true", help="play no episodes for the page, and no matches")
    options.add_argument(
        "--run-dir",
        type=Path,
        metavar="RUN_DIR",
        help="directory of the run, on this machine: the page shows its settings, how it ended and, to holders of a "
        "token, what its actors printed; its newest checkpoint estimates values for the camera, with torch",
    )


def _origin(text: str) -> str:
    if re.fullmatch(r"https?://[^/\s]+/?", text) is None:
        raise argparse.ArgumentTypeError(f"{text!r} is not a web site: write https://HOST or http://HOST:PORT")
    return text


def gateway_options(arguments: argparse.Namespace) -> GatewayOptions:
    """Return what the command line asks for."""
    return GatewayOptions(
        connect=arguments.connect,
        run=arguments.run,
        listen=arguments.listen,
        or_any_port=arguments.or_any_port,
        hosts=arguments.host,
        origins=arguments.allow_origin,
        tls=arguments.tls,
        serve_tls=arguments.serve_tls,
        operator=arguments.operator,
        operator_token=arguments.operator_token,
        insecure=arguments.insecure,
        compare=arguments.compare,
        camera=not arguments.no_camera,
        run_directory=arguments.run_dir,
        allowed_modules=arguments.allow_module,
        takes_clients=not arguments.page_only,
        record=arguments.record,
        for_a_person=arguments.exit_with_parent,
    )


def main() -> int:
    """Run `daedalus gateway` and return its exit status."""
    arguments = parser().parse_args()
    log_options(arguments).configure(process="gateway")
    raise_descriptor_limit()
    stop = stop_on_signals(exit_if_stuck=True)
    if arguments.exit_with_parent:
        exit_with_parent(stop)
    return run_gateway(gateway_options(arguments), stop)


if __name__ == "__main__":
    exit_on_thread_exceptions()
    sys.exit(exit_status(main))
