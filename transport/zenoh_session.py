"""Opening Zenoh sessions, and describing why that failed.

A session either embeds a full router that listens (the learner, by default) or is a client of a router.
"""

import json
import re
import socket
import ssl
from collections.abc import Callable
from typing import Literal, NamedTuple

import zenoh

from daedalus.transport.addresses import socket_path
from daedalus.transport.certificate_expiry import Validity
from daedalus.transport.credentials import (
    CA,
    CERTIFICATE,
    CLIENTS,
    KEY,
    NO_CHECK_TIME,
    Credentials,
    CredentialsError,
    common_name_of,
    is_about_time,
    validity_of,
    with_remedy,
)
from daedalus.transport.interface import AddressInUseError, RefusedError, TransportError
from daedalus.transport.zenoh_settings import Capacity, session_settings

_PROBE_SECONDS = 3.0
_ADDRESS_ADVICE = "is the learner or router running, and is this its address?"


class Diagnosis(NamedTuple):
    """Why a connection failed."""

    reason: str
    is_final: bool  # retrying will not help


def diagnose_connection(endpoint: str, credentials: Credentials | None) -> Diagnosis:
    """Return why no connection to `endpoint` (PROTOCOL/HOST:PORT) can be made, from a connection attempt."""
    path = socket_path(endpoint)
    if path is not None:
        return Diagnosis(_diagnose_socket(path), False)
    host, _, port = endpoint.partition("/")[2].rpartition(":")
    try:
        link = socket.create_connection((host.strip("[]"), int(port)), timeout=_PROBE_SECONDS)
    except socket.gaierror:
        return Diagnosis(_unresolved(host), False)
    except TimeoutError:
        return Diagnosis(no_answer([endpoint]), False)
    except ConnectionRefusedError:
        return Diagnosis(f"nothing answers at {endpoint}: {_ADDRESS_ADVICE}", False)
    except (OSError, ValueError) as error:
        return Diagnosis(f"nothing answers at {endpoint} ({error}): {_ADDRESS_ADVICE}", False)
    with link:
        if credentials is None or not endpoint.startswith("tls/"):
            return Diagnosis(f"the service at {endpoint} uses another protocol, is stopped, or requires --tls", False)
        return _diagnose_refusal(link, host, endpoint, credentials)


def no_answer(endpoints: list[str]) -> str:
    """Return the message where nothing answers for seconds, with what to check."""
    return (
        f"no answer from {' or '.join(endpoints)}: check the address, that its host is up, and that no firewall drops "
        "packets to this port"
    )


def resolved(endpoint: str) -> list[str]:
    """Return an endpoint with each address of its host in place of the name; none if it has no address."""
    if socket_path(endpoint) is not None:
        return [endpoint]
    protocol, _, rest = endpoint.partition("/")
    host, _, port = rest.rpartition(":")
    try:
        found = socket.getaddrinfo(host.strip("[]"), int(port), type=socket.SOCK_STREAM)
    except (OSError, ValueError):
        return []
    addresses = [str(address[0]) for *_, address in found]
    return [f"{protocol}/[{each}]:{port}" if ":" in each else f"{protocol}/{each}:{port}" for each in addresses]


def unresolved_host(endpoint: str) -> str:
    """Return why nothing can listen at `endpoint` if its host has no address, or an empty string."""
    if socket_path(endpoint) is not None:
        return ""
    host = endpoint.partition("/")[2].rpartition(":")[0]
    try:
        socket.getaddrinfo(host.strip("[]"), None)
    except (OSError, UnicodeError):
        return _unresolved(host)
    return ""


def _unresolved(host: str) -> str:
    return f"{host!r} cannot be resolved to an address: check the name"


def _diagnose_socket(path: str) -> str:
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as link:
        link.settimeout(_PROBE_SECONDS)
        try:
            link.connect(path)
        except PermissionError:
            return f"{path} belongs to another user"
        except OSError:
            return f"nothing answers at {path}: {_ADDRESS_ADVICE}"
    return f"the service at {path} uses another protocol"


def _diagnose_refusal(link: socket.socket, host: str, endpoint: str, credentials: Credentials) -> Diagnosis:
    try:
        context = _client_context(credentials)
    except OSError:  # also ssl.SSLError
        return Diagnosis(f"the files in {credentials.directory} cannot be used any more: copy the folder again", False)
    try:
        with context.wrap_socket(link, server_hostname=host.strip("[]")) as secured:
            secured.recv(1)  # with TLS 1.3 a server refuses a certificate only after the client's handshake is done
    except ssl.SSLCertVerificationError as error:
        peer = peer_certificate(endpoint, credentials) if is_about_time(error.verify_message) else None
        service = "service" if peer is None else peer.common_name
        fault = "" if peer is None else peer.validity.fault()
        reason = f"it {fault}" if fault else with_remedy(error.verify_message)
        return Diagnosis(f"the certificate of the {service} at {endpoint} cannot be verified: {reason}", True)
    except ssl.SSLError as error:
        if "alert" in str(error).lower():
            return Diagnosis(f"the service at {endpoint} refuses {_refused(error, credentials)}", True)
        return Diagnosis(f"the service at {endpoint} does not use TLS", False)
    except OSError:
        pass
    return Diagnosis(f"the service at {endpoint} closed the connection", False)


def _client_context(credentials: Credentials) -> ssl.SSLContext:
    """Return the settings of a TLS connection with these credentials. Raises OSError."""
    context = ssl.create_default_context(cafile=str(credentials.directory / CA))
    context.load_cert_chain(credentials.directory / CERTIFICATE, credentials.directory / KEY)
    return context


class PeerCertificate(NamedTuple):
    """What the certificate of a listener states."""

    common_name: str
    validity: Validity


def peer_certificate(endpoint: str, credentials: Credentials) -> PeerCertificate | None:
    """Return the certificate of the router or learner at an endpoint tls/HOST:PORT, also if it has expired.

    None if nothing answers within some seconds, or if the certificate is not signed by the CA.
    """
    host, _, port = endpoint.partition("/")[2].rpartition(":")
    try:
        context = _client_context(credentials)
        context.verify_flags |= NO_CHECK_TIME
        with (
            socket.create_connection((host.strip("[]"), int(port)), timeout=_PROBE_SECONDS) as link,
            context.wrap_socket(link, server_hostname=host.strip("[]")) as secured,
        ):
            certificate = secured.getpeercert()
    except (OSError, ValueError):  # also ssl.SSLError
        return None
    return PeerCertificate(common_name_of(certificate), validity_of(certificate)) if certificate else None


def _refused(error: ssl.SSLError, credentials: Credentials) -> str:
    """Return what a service refuses, from its alert. The service itself was verified before."""
    reason = (error.reason or str(error)).lower().replace("_", " ")
    reason = reason.partition("alert ")[2] or reason
    certificate = f"the certificate in {credentials.directory}"
    if reason in ("unknown ca", "decrypt error"):
        return f"{certificate}: it was revoked, or issued after the service's copy of {CLIENTS}"
    if is_about_time(reason):  # this end has found the certificate valid
        return (
            f"{certificate} as expired or not yet valid, and by the clock of this host it is valid now "
            f"({credentials.validity().period()}): the clock of one of the two hosts is wrong"
        )
    return f"{certificate}: {with_remedy(reason)}"


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
        credentials.watch_expiry()

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
                credentials.check_valid_now()
            except CredentialsError as error:
                return RefusedError(str(error))
        diagnoses = [diagnose_connection(endpoint, credentials) for endpoint in connect_to]
        is_final = all(diagnosis.is_final for diagnosis in diagnoses)
        return (RefusedError if is_final else TransportError)("; ".join(diagnosis.reason for diagnosis in diagnoses))
    reason = next(filter(None, map(unresolved_host, listen_on)), "") or text.splitlines()[0][:200]
    return TransportError(f"cannot listen on {', '.join(listen_on)}: {reason}")
