"""Explains a connection that failed, by a TLS handshake of its own: Zenoh reports only that a link failed."""

import socket
import ssl
from typing import NamedTuple

from daedalus.transport.addresses import socket_path
from daedalus.transport.credentials import CA, CERTIFICATE, CLIENTS, KEY, Credentials, with_remedy

_PROBE_SECONDS = 3.0


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
    except (OSError, ValueError):
        return Diagnosis(f"nothing answers at {endpoint}", False)
    with link:
        if credentials is None or not endpoint.startswith("tls/"):
            return Diagnosis(f"the service at {endpoint} uses another protocol, or requires --tls", False)
        return _diagnose_refusal(link, host, endpoint, credentials)


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
            return f"nothing answers at {path}"
    return f"the service at {path} uses another protocol"


def _diagnose_refusal(link: socket.socket, host: str, endpoint: str, credentials: Credentials) -> Diagnosis:
    try:
        context = ssl.create_default_context(cafile=str(credentials.directory / CA))
        context.load_cert_chain(credentials.directory / CERTIFICATE, credentials.directory / KEY)
    except OSError:  # also ssl.SSLError
        return Diagnosis(f"the files in {credentials.directory} cannot be used any more: copy the folder again", False)
    try:
        with context.wrap_socket(link, server_hostname=host.strip("[]")) as secured:
            secured.recv(1)  # with TLS 1.3 a server refuses a certificate only after the client's handshake is done
    except ssl.SSLCertVerificationError as error:
        reason = with_remedy(error.verify_message)
        return Diagnosis(f"the certificate of the service at {endpoint} cannot be verified: {reason}", True)
    except ssl.SSLError as error:
        if "alert" in str(error).lower():
            return Diagnosis(f"the service at {endpoint} refuses {_refused(error, credentials)}", True)
        return Diagnosis(f"the service at {endpoint} does not use TLS", False)
    except OSError:
        pass
    return Diagnosis(f"the service at {endpoint} closed the connection", False)


def _refused(error: ssl.SSLError, credentials: Credentials) -> str:
    """Return what a service refuses, from its alert. The service itself was verified before."""
    reason = (error.reason or str(error)).lower().replace("_", " ")
    reason = reason.partition("alert ")[2] or reason
    certificate = f"the certificate in {credentials.directory}"
    if reason in ("unknown ca", "decrypt error"):
        return f"{certificate}: it was revoked, or issued after the service's copy of {CLIENTS}"
    return f"{certificate}: {with_remedy(reason)}"
