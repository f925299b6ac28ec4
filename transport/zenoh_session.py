"""Opening Zenoh sessions, and describing why that failed.

A session either embeds a full router that listens (the learner, by default) or is a client of a router.
"""

import contextlib
import json
import re
from collections.abc import Callable
from typing import Literal

import zenoh

from daedalus.transport.credentials import Credentials, CredentialsError
from daedalus.transport.diagnosis import diagnose_connection, unresolved_host
from daedalus.transport.interface import AddressInUseError, RefusedError, TransportError
from daedalus.transport.zenoh_settings import Capacity, session_settings

OpenSession = Callable[[], zenoh.Session]

_SOURCE = re.compile(r" at \S+\.rs:\d+\.?")  # in errors of Zenoh, a place in its own source text


def session_opener(
    mode: Literal["router", "client"],
    listen_on: list[str],
    connect_to: list[str],
    credentials: Credentials | None,
    max_message_bytes: int,
) -> OpenSession:
    """Return a function that opens a session with these settings, each time a new one.

    The session receives messages of at most `max_message_bytes`, and drops larger ones while they arrive.

    The function raises AddressInUseError, RefusedError or TransportError, and CredentialsError if the folder of
    `credentials` does not list the authorised names and the session listens. It reads the folder each time.
    """
    capacity = Capacity(message_bytes=max_message_bytes, descriptors=_descriptors())
    if credentials is not None:
        with contextlib.suppress(CredentialsError):  # a file is being copied: opening the session says so
            credentials.warn_of_expiry()

    def open_session() -> zenoh.Session:
        security = credentials.settings(listens=bool(listen_on)) if credentials else {}
        settings = session_settings(mode, listen_on, connect_to, security, capacity)
        config = zenoh.Config()
        try:
            for name, value in settings.items():
                config.insert_json5(name, json.dumps(value))
            return zenoh.open(config)
        except zenoh.ZError as error:
            raise _opening_error(error_text(error), listen_on, connect_to, credentials) from None

    return open_session


def error_text(error: zenoh.ZError) -> str:
    """Return the message of an error of Zenoh, without places in its source text."""
    return _SOURCE.sub("", str(error))


def _descriptors() -> int:
    """Return the number of file descriptors that this process may have open."""
    try:
        import resource
    except ModuleNotFoundError:  # Windows
        return Capacity().descriptors
    soft, _ = resource.getrlimit(resource.RLIMIT_NOFILE)
    return Capacity().descriptors if soft == resource.RLIM_INFINITY else soft


def _opening_error(
    text: str, listen_on: list[str], connect_to: list[str], credentials: Credentials | None
) -> TransportError:
    if "in use" in text:
        return AddressInUseError(
            f"address {', '.join(listen_on)} is already in use: "
            "stop the process that listens there, or choose another address with --listen"
        )
    if connect_to:
        if credentials is not None:
            try:
                credentials.check_expiry()
            except CredentialsError as error:
                return RefusedError(str(error))
        diagnoses = [diagnose_connection(endpoint, credentials) for endpoint in connect_to]
        is_final = all(diagnosis.is_final for diagnosis in diagnoses)
        return (RefusedError if is_final else TransportError)("; ".join(diagnosis.reason for diagnosis in diagnoses))
    reason = next(filter(None, map(unresolved_host, listen_on)), "") or text.splitlines()[0][:200]
    return TransportError(f"cannot listen on {', '.join(listen_on)}: {reason}")
