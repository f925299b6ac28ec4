"""The network of a learner: credentials, addresses, the transport, and the addresses that actors are given."""

import argparse
import logging
import threading

from daedalus.cli.settings_arguments import LISTEN, ChosenRun
from daedalus.learner.serving.rollout_intake import largest_request
from daedalus.policy.user_modules import allow_settings, shown_path
from daedalus.protocol.spec import RunSpec
from daedalus.transport.addresses import reachable
from daedalus.transport.connecting import connect_with_retry, listen
from daedalus.transport.credentials import Credentials, credentials_to_connect, credentials_to_listen
from daedalus.transport.interface import Transport

_logger = logging.getLogger(__name__)


def learner_credentials(arguments: argparse.Namespace) -> Credentials | None:
    """Return the credentials for the addresses, or None without TLS. Raises SECURITY_ERRORS."""
    if arguments.connect:
        return credentials_to_connect(arguments.connect, arguments.tls, "learner")
    return credentials_to_listen(addresses_of(arguments), arguments.tls, "learner", insecure=arguments.insecure)


def addresses_of(arguments: argparse.Namespace) -> list[str]:
    """Return the addresses that actors connect to."""
    return arguments.connect or arguments.listen or [LISTEN]


def open_transport(
    arguments: argparse.Namespace, spec: RunSpec, credentials: Credentials | None, stop: threading.Event
) -> Transport | None:
    """Connect to a router or listen for actors; return None if stopped before a router answered.

    Raises TransportError or CredentialsError.
    """
    limit = largest_request(spec)
    if arguments.connect:
        return connect_with_retry(arguments.connect, stop, credentials=credentials, max_message_bytes=limit)
    return listen(addresses_of(arguments), credentials=credentials, max_message_bytes=limit)


def how_to_join(listening: list[str], credentials: Credentials | None, spec: RunSpec) -> str:
    """Return the command of an actor, with the other addresses that it may use."""
    address, *others = reachable(listening, credentials.hosts() if credentials else ())
    tls = ["--tls", "DIR"] if credentials else []
    command = ["daedalus actor --connect", address, *tls, *allow_settings(spec.actor_modules)]
    return " ".join([*command, *([f"(or at {', '.join(others)})"] if others else [])])


def announce(run: ChosenRun, arguments: argparse.Namespace, credentials: Credentials | None) -> None:
    """Log how actors join."""
    if arguments.prepared is None:
        spec = run.spec
        _logger.info(
            "run %s: learning %s with %s", shown_path(str(run.directory)), spec.environment.id, spec.training.algorithm
        )
        _logger.info("actors join with: %s", how_to_join(addresses_of(arguments), credentials, spec))
