"""`daedalus gateway`: actors in any language, over WebSockets, and the page of a run.

Exit status: 0 stopped by a signal, 1 failed, 2 bad usage.
"""

import argparse
import asyncio
import errno
import os
import re
import socket
import sys
import threading
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from daedalus.actor.errors import ActorError
from daedalus.cli.arguments import add_allow_module, add_connect, add_insecure, add_logging, add_tls, command_parser
from daedalus.cli.gateway_packages import INSTALL
from daedalus.cli.other_runs import OtherRuns
from daedalus.gateway.security import OperatorToken
from daedalus.launch.logs import configure_logging, print_error, say
from daedalus.launch.process_lifecycle import (
    BAD_USAGE,
    exit_on_thread_exceptions,
    exit_status,
    exit_with_parent,
    raise_descriptor_limit,
    stop_on_signals,
)
from daedalus.policy.acting.runtime import PolicyError
from daedalus.policy.user_modules import allow_words
from daedalus.protocol import keys
from daedalus.transport.addresses import AddressError, check_listening
from daedalus.transport.credentials import SECURITY_ERRORS, Credentials, NotValidNowError, credentials_to_connect, load
from daedalus.transport.interface import TransportError
from daedalus.transport.retries import Retries

LISTEN = "127.0.0.1:8080"

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
    add_connect(options, "address of the learner or of its router. May be given several times")
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
    options.add_argument("--no-camera", action="store_true", help="play no episodes for the page")
    options.add_argument(
        "--checkpoints",
        type=Path,
        metavar="RUN_DIR",
        help="directory of the run, on this machine: its newest checkpoint estimates values for the camera, with torch",
    )


def _origin(text: str) -> str:
    if re.fullmatch(r"https?://[^/\s]+/?", text) is None:
        raise argparse.ArgumentTypeError(f"{text!r} is not a web site: write https://HOST or http://HOST:PORT")
    return text


@dataclass(frozen=True, slots=True, kw_only=True)
class _Chosen:
    """What the files that the command line names contain."""

    credentials: Credentials | None
    operator: Credentials | None
    serving: Credentials | None
    operator_token: OperatorToken | None
    other_runs: OtherRuns

    @classmethod
    def of(cls, arguments: argparse.Namespace) -> "_Chosen":
        """Read the files. Raises SECURITY_ERRORS, OSError or ValueError."""
        if arguments.operator is not None and arguments.tls is None:
            raise ValueError("--operator is for networks with certificates: use --tls too, or leave it out")
        if arguments.operator_token is not None and arguments.serve_tls is not None:
            raise ValueError("--operator-token is for gateways without --serve-tls: operators have tokens of their own")
        token = None if arguments.operator_token is None else OperatorToken(arguments.operator_token)
        return cls(
            credentials=credentials_to_connect(arguments.connect, arguments.tls, "actor"),
            operator=None if arguments.operator is None else load(arguments.operator, "operator"),
            serving=None if arguments.serve_tls is None else load(arguments.serve_tls, "gateway"),
            operator_token=token,
            other_runs=OtherRuns(arguments.compare),
        )


def main() -> int:
    """Run `daedalus gateway` and return its exit status."""
    arguments = parser().parse_args()
    configure_logging(arguments.log_level, as_json=arguments.log_json, process="gateway")
    raise_descriptor_limit()
    stop = stop_on_signals(exit_if_stuck=True)
    if arguments.exit_with_parent:
        exit_with_parent(stop)
    retries = Retries(stop)
    while True:
        try:
            if arguments.run != keys.ANY_RUN:
                keys.check_name(arguments.run, "run")
            chosen = _Chosen.of(arguments)
            host, port = _listening_address(arguments.listen, chosen.serving is not None, arguments.insecure)
            break
        except NotValidNowError as error:
            if retries.wait(str(error)):
                return 0
        except (ValueError, OSError, *SECURITY_ERRORS) as error:
            print_error("gateway", error)
            return BAD_USAGE
    try:
        listener = _listen(host, port, arguments.or_any_port)
    except OSError as error:
        reason = (error.strerror or str(error)).partition(" (while attempting")[0]  # of socket.create_server
        text = f"cannot listen on {arguments.listen}: {reason}: choose another --listen"
        print_error("gateway", text)
        return 1
    try:
        asyncio.run(_serve(arguments, chosen, listener, stop))
        return 0
    except (ActorError, PolicyError, TransportError, OSError, ValueError) as error:
        print_error("gateway", error)
        return 1
    except ImportError:
        print_error("gateway", INSTALL)
        return 1
    finally:
        listener.close()


def _camera(arguments: argparse.Namespace) -> tuple[str, ...]:
    """Return the command of the camera's process."""
    values = [] if arguments.checkpoints is None else ["--checkpoints", str(arguments.checkpoints)]
    return (sys.executable, "-P", "-m", "daedalus.launch.camera_process", *allow_words(arguments.allow_module), *values)


def _announce(token_file: Path | None) -> Callable[[str], None]:
    """Return a function that prints the address of the page, for the person who started the run.

    It does not print the token: the output may go to a log that others can read.
    """
    token = "" if token_file is None else f" with the token in {os.path.relpath(token_file)}"
    return lambda address: say(f"watch the run at {address}{token}")


async def _serve(
    arguments: argparse.Namespace, chosen: "_Chosen", listener: socket.socket, stop: threading.Event
) -> None:
    # Imported here, because its packages are an extra.
    from daedalus.gateway.service import GatewayService, GatewaySettings

    settings = GatewaySettings(
        connect=arguments.connect,
        shown_host=arguments.listen.rpartition(":")[0],
        run=arguments.run,
        credentials=chosen.credentials,
        operator=chosen.operator,
        serving=chosen.serving,
        hosts=arguments.host,
        origins=arguments.allow_origin,
        operator_token=chosen.operator_token,
        other_runs=chosen.other_runs,
        camera=None if arguments.no_camera else _camera(arguments),
        takes_clients=not arguments.page_only,
        announce=_announce(arguments.operator_token) if arguments.exit_with_parent else None,
    )
    await GatewayService(settings, stop).run(listener)


def _listen(host: str, port: int, or_any: bool) -> socket.socket:
    """Return a listening socket, at another port if the port is taken and any will do. Raises OSError."""
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    try:
        return socket.create_server((host, port), family=family)
    except OSError as error:
        if not or_any or error.errno != errno.EADDRINUSE:
            raise
        return socket.create_server((host, 0), family=family)


def _listening_address(listen: str, tls: bool, insecure: bool) -> tuple[str, int]:
    """Return host and port. Raises AddressError if others could connect without TLS."""
    host, colon, port = listen.rpartition(":")
    if not colon or not host or not port.isdecimal() or int(port) > 65535:
        raise AddressError(f"{listen!r} is not an address: write HOST:PORT, such as {LISTEN}")
    checked = f"{'tls' if tls else 'tcp'}/{host}:{port if int(port) else 1}"  # with 0 the gateway names the one it got
    try:
        check_listening([checked], tls=tls, insecure=insecure)
    except AddressError:
        raise AddressError(
            f"{listen} is unencrypted and open to every host that can reach it: use --serve-tls (daedalus certs issue "
            f"gateway), listen on {LISTEN}, or add --insecure on a network that you trust"
        ) from None
    return host.strip("[]"), int(port)


if __name__ == "__main__":
    exit_on_thread_exceptions()
    sys.exit(exit_status(main))
