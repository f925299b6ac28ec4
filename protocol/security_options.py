"""The part of a command line that says who may be talked to: the same words for every command."""

import argparse
from pathlib import Path

from protocol.addresses import AddressError, check_connecting, check_listening
from protocol.credentials import Credentials, CredentialsError, load

SECURITY_ERRORS = (AddressError, CredentialsError)


def add_tls(options: argparse._ActionsContainer) -> None:
    """Adds --tls."""
    options.add_argument(
        "--tls",
        type=Path,
        metavar="DIR",
        help="this one's certificate, for addresses that begin with tls/ (daedalus certs makes them)",
    )


def add_insecure(options: argparse._ActionsContainer) -> None:
    """Adds --insecure, for those that listen."""
    options.add_argument(
        "--insecure",
        action="store_true",
        help="listen beyond this machine although whoever reaches the address may take part, unseen and unchecked",
    )


def credentials_to_listen(endpoints: list[str], tls: Path | None, role: str, *, insecure: bool) -> Credentials | None:
    """The certificate to listen with, if there is one. Raises one of SECURITY_ERRORS."""
    check_listening(endpoints, tls=tls is not None, insecure=insecure)
    return None if tls is None else load(tls, role)


def credentials_to_connect(endpoints: list[str], tls: Path | None, *roles: str) -> Credentials | None:
    """The certificate to connect with, if there is one. Raises one of SECURITY_ERRORS."""
    check_connecting(endpoints, tls=tls is not None)
    return None if tls is None else load(tls, *roles)
