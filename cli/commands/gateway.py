"""`daedalus gateway`: actors in any language, over WebSockets.

Exit status: 0 stopped by a signal, 1 failed, 2 bad usage.
"""

import argparse
import asyncio
import logging
import os
import re
import socket
import sys
import threading
from pathlib import Path

from daedalus.actor.session.learner_queries import ActorError
from daedalus.cli.arguments import add_connect, add_insecure, add_tls, command_parser
from daedalus.cli.logs import add_logging, configure_logging
from daedalus.cli.processes import (
    exit_on_thread_exceptions,
    exit_status,
    exit_with_parent,
    raise_descriptor_limit,
    stop_on_signals,
)
from daedalus.policy.acting.runtime import PolicyError
from daedalus.protocol import keys
from daedalus.transport.addresses import AddressError, check_listening
from daedalus.transport.connecting import connect, connect_with_retry
from daedalus.transport.credentials import Credentials, load
from daedalus.transport.interface import Transport, TransportError
from daedalus.transport.security import SECURITY_ERRORS, credentials_to_connect

_logger = logging.getLogger("daedalus.cli")  # this module is __main__ when it runs

LISTEN = "127.0.0.1:8080"
INSTALL = 'the gateway needs starlette, uvicorn and websockets: pip install "daedalus-rl[gateway]"'
_HEARTBEAT_SECONDS = 0.2

DESCRIPTION = """\
Lets programs in any language be actors, over a WebSocket: they send observations and rewards, and the gateway runs the
policy, collects the rollouts and sends them to the learner. Programs that run the policy themselves exchange the
messages of docs/wire.md with it. On loopback everybody may connect; any other address needs --serve-tls, and each
client a token."""

EXAMPLES = """\
examples:
  daedalus gateway --connect tcp/127.0.0.1:7447
  daedalus certs issue gateway --host play.example
  daedalus certs issue client phone-1
  daedalus gateway --connect tcp/127.0.0.1:7447 --listen 0.0.0.0:8443 --serve-tls certs/gateway
  daedalus gateway --connect tls/gpu-box:7447 --tls certs/actor-gateway

exit status: 0 stopped by a signal, 1 failed, 2 bad usage"""


def parser() -> argparse.ArgumentParser:
    """Return the parser of `daedalus gateway`."""
    options = command_parser("gateway", DESCRIPTION, EXAMPLES)
    add_connect(options, "address of the learner or of its router. May be given several times")
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
        "--run", default=keys.ANY_RUN, metavar="NAME", help="run to follow, if several runs share a network"
    )
    add_tls(options)
    add_insecure(options)
    add_logging(options)
    options.add_argument("--exit-with-parent", action="store_true", help=argparse.SUPPRESS)
    return options


def _origin(text: str) -> str:
    if re.fullmatch(r"https?://[^/\s]+/?", text) is None:
        raise argparse.ArgumentTypeError(f"{text!r} is not a web site: write https://HOST or http://HOST:PORT")
    return text


def main() -> int:
    """Run `daedalus gateway` and return its exit status."""
    arguments = parser().parse_args()
    configure_logging(arguments.log_level, as_json=arguments.log_json, process="gateway")
    try:
        if arguments.run != keys.ANY_RUN:
            keys.check_name(arguments.run, "run")
        credentials = credentials_to_connect(arguments.connect, arguments.tls, "actor")
        serving = None if arguments.serve_tls is None else load(arguments.serve_tls, "gateway")
        host, port = _listening_address(arguments.listen, serving is not None, arguments.insecure)
    except (ValueError, *SECURITY_ERRORS) as error:
        print(f"daedalus gateway: {error}", file=sys.stderr)
        return 2
    raise_descriptor_limit()
    stop = stop_on_signals(exit_if_stuck=True)
    if arguments.exit_with_parent:
        exit_with_parent(stop)
    try:
        listener = socket.create_server((host, port), family=socket.AF_INET6 if ":" in host else socket.AF_INET)
    except OSError as error:
        print(
            f"daedalus gateway: cannot listen on {arguments.listen}: {os.strerror(error.errno or 0)}", file=sys.stderr
        )
        return 1
    transport: Transport | None = None
    try:
        transport = connect_with_retry(arguments.connect, stop, None, credentials)
        if transport is None:
            return 0
        return asyncio.run(_serve(arguments, transport, listener, credentials, serving, stop))
    except (ActorError, PolicyError, TransportError, OSError, ValueError) as error:
        print(f"daedalus gateway: {error}", file=sys.stderr)
        return 1
    except ImportError:
        print(f"daedalus gateway: {INSTALL}", file=sys.stderr)
        return 1
    finally:
        listener.close()
        if transport is not None:
            transport.close()


def _listening_address(listen: str, tls: bool, insecure: bool) -> tuple[str, int]:
    """Return host and port. Raises AddressError if others could connect without TLS."""
    host, colon, port = listen.rpartition(":")
    if not colon or not host or not port.isdecimal() or int(port) > 65535:
        raise AddressError(f"{listen!r} is not an address: write HOST:PORT, such as {LISTEN}")
    try:
        check_listening([f"{'tls' if tls else 'tcp'}/{listen}"], tls=tls, insecure=insecure)
    except AddressError:
        raise AddressError(
            f"{listen} is unencrypted and open to every host that can reach it: use --serve-tls (daedalus certs issue "
            f"gateway), listen on {LISTEN}, or add --insecure on a network that you trust"
        ) from None
    return host.strip("[]"), int(port)


async def _serve(
    arguments: argparse.Namespace,
    transport: Transport,
    listener: socket.socket,
    credentials: Credentials | None,
    serving: Credentials | None,
    stop: threading.Event,
) -> int:
    """Serve until a signal, or until the gateway fails; raises what made it fail."""
    from daedalus.gateway.app import application
    from daedalus.gateway.gateway import Gateway, GatewayConfig
    from daedalus.gateway.raw.endpoint import RawEndpoint
    from daedalus.gateway.security import LOOPBACK, guard
    from daedalus.gateway.server import Server, tls_context
    from daedalus.gateway.tokens import Tokens

    ended, failures = asyncio.Event(), []

    def fail(error: Exception) -> None:
        failures.append(error)
        ended.set()

    owner = credentials.name if credentials else ""
    name = f"{owner or 'gateway'}.gateway-{os.getpid()}"
    tokens = None if serving is None else Tokens(serving.directory)
    tls = None if serving is None else tls_context(serving.directory)
    port = listener.getsockname()[1]
    names = [*LOOPBACK, *arguments.host, *([] if serving is None else _bracketed(serving.hosts()))]
    config = GatewayConfig(name=name, owner=owner, run=arguments.run)
    gateway = Gateway(transport, config, fail)
    gateway.open()
    watch = asyncio.create_task(_set_when_stopped(stop, ended))
    rules = guard([*names, socket.gethostname()], port, arguments.allow_origin, tokens)
    shown = arguments.listen.rpartition(":")[0]
    _logger.info("clients connect to %s://%s:%d/actor", "wss" if tls else "ws", shown, port)
    raw = RawEndpoint(lambda: connect(arguments.connect, credentials), rules, config.actor_name)

    async def close() -> None:
        await raw.close()
        await gateway.close()

    await Server(application(gateway, raw, rules), tls).run_until(ended, listener, close)
    watch.cancel()
    if failures:
        raise failures[0]
    return 0


async def _set_when_stopped(stop: threading.Event, ended: asyncio.Event) -> None:
    while not stop.is_set():
        await asyncio.sleep(_HEARTBEAT_SECONDS)
    ended.set()


def _bracketed(hosts: list[str]) -> list[str]:
    return [f"[{host}]" if ":" in host else host for host in hosts]


if __name__ == "__main__":
    exit_on_thread_exceptions()
    sys.exit(exit_status(main))
