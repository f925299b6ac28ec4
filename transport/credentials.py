"""The folder given by `--tls`: a certificate, its key and the CA that both ends trust; and diagnoses of failures.

    ca.pem  certificate.pem  key.pem      created by `daedalus certs`
    names.json                            for a router or learner: the authorised actors and operators

Zenoh reports only that a link failed. So this file checks certificates before they are used, and explains a refused
connection afterwards, by TLS handshakes of its own.
"""

import contextlib
import json
import socket
import ssl
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

from daedalus.transport.access_control import access_control

CA, CERTIFICATE, KEY, NAMES = "ca.pem", "certificate.pem", "key.pem", "names.json"
_PROBE_SECONDS = 3.0


class CredentialsError(Exception):
    """A folder of credentials that cannot be used; the message says why and what to do."""


@dataclass(frozen=True, slots=True)
class Credentials:
    """Verified credentials of one process: its role, and the name of an actor or operator."""

    directory: Path
    role: str  # learner, router, actor, operator
    name: str  # empty for a learner or router

    def settings(self, *, listens: bool) -> dict[str, Any]:
        """Return Zenoh's settings for mutual TLS and, if the session listens, for access control.

        Raises CredentialsError if the session listens and names.json is not readable.
        """
        tls = "transport/link/tls"
        certificate, key = str(self.directory / CERTIFICATE), str(self.directory / KEY)
        settings: dict[str, Any] = {
            f"{tls}/root_ca_certificate": str(self.directory / CA),
            f"{tls}/enable_mtls": True,
            f"{tls}/connect_certificate": certificate,
            f"{tls}/connect_private_key": key,
            f"{tls}/close_link_on_expiration": True,
        }
        if listens:
            settings[f"{tls}/listen_certificate"], settings[f"{tls}/listen_private_key"] = certificate, key
            settings["access_control"] = access_control(**read_names(self.directory))
        return settings


def load(directory: Path, *roles: str) -> Credentials:
    """Return the verified credentials in a folder.

    Raises CredentialsError if a file is missing or damaged, the certificate is not valid now or not signed by the CA,
    or its role is not one of `roles`.
    """
    for name in (CA, CERTIFICATE, KEY):
        if not (directory / name).is_file():
            raise CredentialsError(f"{directory} has no {name}: create such a folder with `daedalus certs`")
    subject = _verified_subject(directory)
    role, _, name = subject.partition(":")
    if role not in roles:
        raise CredentialsError(
            f"{directory} holds the certificate of {_described(role, name)}, but {' or '.join(roles)} is required: "
            f"issue one (daedalus certs issue {roles[0]})"
        )
    return Credentials(directory, role, name)


def read_names(directory: Path) -> dict[str, list[str]]:
    """Return the authorised names, `actors` and `operators`. Raises CredentialsError if names.json is not readable."""
    try:
        names = json.loads((directory / NAMES).read_text("utf-8"))
    except (OSError, ValueError):
        raise CredentialsError(f"{directory} has no readable {NAMES}: create it with `daedalus certs`") from None
    if not isinstance(names, dict) or set(names) != {"actors", "operators"}:
        raise CredentialsError(f"{directory / NAMES} must have exactly the entries actors and operators")
    return names


class Diagnosis(NamedTuple):
    """Why a connection failed."""

    reason: str
    is_final: bool  # retrying will not help


def diagnose_connection(endpoint: str, credentials: Credentials | None) -> Diagnosis:
    """Return why no connection to `endpoint` (PROTOCOL/HOST:PORT) can be made, from a connection attempt."""
    host, _, port = endpoint.partition("/")[2].rpartition(":")
    try:
        link = socket.create_connection((host.strip("[]"), int(port)), timeout=_PROBE_SECONDS)
    except socket.gaierror:
        return Diagnosis(f"{host!r} cannot be resolved to an address: check the name", False)
    except (OSError, ValueError):
        return Diagnosis(f"nothing answers at {endpoint}", False)
    with link:
        if credentials is None or not endpoint.startswith("tls/"):
            return Diagnosis(f"the service at {endpoint} uses another protocol, or requires --tls", False)
        return _diagnose_refusal(link, host, endpoint, credentials)


def _diagnose_refusal(link: socket.socket, host: str, endpoint: str, credentials: Credentials) -> Diagnosis:
    context = ssl.create_default_context(cafile=str(credentials.directory / CA))
    context.load_cert_chain(credentials.directory / CERTIFICATE, credentials.directory / KEY)
    try:
        with context.wrap_socket(link, server_hostname=host.strip("[]")) as secured:
            secured.recv(1)  # with TLS 1.3 a server refuses a certificate only after the client's handshake is done
    except ssl.SSLCertVerificationError as error:
        reason = _with_remedy(error.verify_message)
        return Diagnosis(f"the certificate of the service at {endpoint} cannot be verified: {reason}", True)
    except ssl.SSLError as error:
        if "alert" in str(error).lower():
            return Diagnosis(
                f"the service at {endpoint} refuses the certificate in {credentials.directory}: {_alert(error)}", True
            )
        return Diagnosis(f"the service at {endpoint} does not use TLS", False)
    except OSError:
        pass
    return Diagnosis(f"the service at {endpoint} closed the connection", False)


def _alert(error: ssl.SSLError) -> str:
    reason = (error.reason or str(error)).lower().replace("_", " ")
    return _with_remedy(reason.partition("alert ")[2] or reason)


def _with_remedy(reason: str) -> str:
    """Return a reason given by OpenSSL, with what to do about it."""
    if "expired" in reason:
        return f"{reason}: issue a new one (daedalus certs issue)"
    if "issuer" in reason or "unknown ca" in reason or "self-signed" in reason or "decrypt error" in reason:
        return f"{reason}: the two ends use different CAs (ca.pem must be the same on both sides)"
    if "mismatch" in reason:
        return f"{reason}: issue the certificate for this host (--host)"
    return reason


def _described(role: str, name: str) -> str:
    return f"{role} {name!r}" if name else role


def _verified_subject(directory: Path) -> str:
    """Return the common name of a certificate that fits its key, is valid now and is signed by its CA.

    Verifies by a TLS handshake with itself in memory: on the network the same failure would have no explanation.
    Raises CredentialsError.
    """
    server = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    try:
        server.load_cert_chain(directory / CERTIFICATE, directory / KEY)
    except ssl.SSLError as error:
        if error.reason == "KEY_VALUES_MISMATCH":
            raise CredentialsError(f"{directory}: {KEY} is not the key of {CERTIFICATE}: copy both again") from None
        raise CredentialsError(f"{directory}: {CERTIFICATE} or {KEY} is damaged: copy both again") from None
    server.verify_mode = ssl.CERT_REQUIRED
    client = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
    client.check_hostname, client.verify_mode = False, ssl.CERT_NONE  # only the client's certificate is verified
    client.load_cert_chain(directory / CERTIFICATE, directory / KEY)
    try:
        server.load_verify_locations(directory / CA)
        certificate = _handshake(client, server)
    except ssl.SSLCertVerificationError as error:
        raise CredentialsError(f"{directory}: {CERTIFICATE}: {_with_remedy(error.verify_message)}") from None
    except ssl.SSLError:
        raise CredentialsError(f"{directory}: {CA} is damaged: copy it again") from None
    subject = {key: value for part in certificate.get("subject", ()) for key, value in part}
    return str(subject.get("commonName", ""))


def _handshake(client: ssl.SSLContext, server: ssl.SSLContext) -> dict[str, Any]:
    """Return the client's certificate as the server verified it. Raises SSLError."""
    up, down = ssl.MemoryBIO(), ssl.MemoryBIO()
    ends = [client.wrap_bio(down, up), server.wrap_bio(up, down, server_side=True)]
    for _ in range(4):  # more rounds than a TLS handshake needs
        for end in ends:
            with contextlib.suppress(ssl.SSLWantReadError):
                end.do_handshake()
    return dict(ends[1].getpeercert() or {})
