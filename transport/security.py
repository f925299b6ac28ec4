"""The credentials that an address needs, checked before a socket is opened."""

import contextlib
from pathlib import Path

from daedalus.transport.addresses import AddressError, check_connecting, check_listening
from daedalus.transport.credentials import Credentials, CredentialsError, load

SECURITY_ERRORS = (AddressError, CredentialsError)


def credentials_to_listen(endpoints: list[str], tls: Path | None, role: str, *, insecure: bool) -> Credentials | None:
    """Return the certificate to listen with, or None without `tls`. Raises one of SECURITY_ERRORS."""
    check_listening(endpoints, tls=tls is not None, insecure=insecure)
    return None if tls is None else load(tls, role)


def credentials_to_connect(endpoints: list[str], tls: str | Path | None, *roles: str) -> Credentials | None:
    """Return the certificate to connect with, or None without `tls`. Raises one of SECURITY_ERRORS."""
    check_connecting(endpoints, tls=tls is not None)
    return None if tls is None else load(Path(tls), *roles)


def certificate_days_left(credentials: Credentials | None) -> float | None:
    """Return the days until a certificate expires, or None without one, or while it is being replaced."""
    with contextlib.suppress(CredentialsError):
        return None if credentials is None else credentials.days_left()
    return None
