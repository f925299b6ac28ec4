"""The folder behind `--tls`: a certificate, its key, the CA that both ends trust; and what is wrong with them.

    ca.pem  certificate.pem  key.pem      made by `daedalus certs`
    names.json                            a router's and a learner's: whom it lets in

Zenoh only says that a link failed. So certificates are looked at here first, and refusals explained after, by a
handshake of Python's own.
"""

import contextlib
import json
import socket
import ssl
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from daedalus.transport.access_control import access_control

CA, CERTIFICATE, KEY, NAMES = "ca.pem", "certificate.pem", "key.pem", "names.json"
_PROBE_SECONDS = 3.0


class CredentialsError(Exception):
    """A certificate does not serve; the message says why and what to do."""


@dataclass(frozen=True, slots=True)
class Credentials:
    """One identity: a role, and the name of an actor or operator. Its files were found in order."""

    directory: Path
    role: str  # learner, router, actor, operator
    name: str  # empty for a learner or router

    def settings(self, *, listens: bool) -> dict[str, Any]:
        """Zenoh's settings for both ends of mutual TLS and, where it listens, for whom it lets in."""
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
    """Looks at the folder that `--tls` names. Raises CredentialsError if it does not serve one of `roles`."""
    for name in (CA, CERTIFICATE, KEY):
        if not (directory / name).is_file():
            raise CredentialsError(f"{directory} has no {name}: `daedalus certs` makes such folders")
    subject = _verified_subject(directory)
    role, _, name = subject.partition(":")
    if role not in roles:
        raise CredentialsError(
            f"{directory} holds the certificate of {_described(role, name)}: "
            f"{' or '.join(roles)} was expected, so give it its own (daedalus certs issue {roles[0]})"
        )
    return Credentials(directory, role, name)


def read_names(directory: Path) -> dict[str, list[str]]:
    """Whom a router lets in: `actors` and `operators`. Raises CredentialsError if the folder does not tell."""
    try:
        names = json.loads((directory / NAMES).read_text("utf-8"))
    except (OSError, ValueError):
        raise CredentialsError(f"{directory} has no {NAMES} that can be read: `daedalus certs` makes it") from None
    if not isinstance(names, dict) or set(names) != {"actors", "operators"}:
        raise CredentialsError(f"{directory / NAMES} must hold actors and operators")
    return names


def diagnose_connection(endpoint: str, credentials: Credentials | None) -> tuple[str, bool]:
    """Why no connection to PROTOCOL/HOST:PORT came about, and whether that is for good: no waiting mends it."""
    host, _, port = endpoint.partition("/")[2].rpartition(":")
    try:
        link = socket.create_connection((host.strip("[]"), int(port)), timeout=_PROBE_SECONDS)
    except socket.gaierror:
        return f"{host!r} resolves to no address: is the name right?", False
    except (OSError, ValueError):
        return f"nothing answers at {endpoint}", False
    with link:
        if credentials is None or not endpoint.startswith("tls/"):
            return f"what answers at {endpoint} speaks another protocol, or wants --tls", False
        return _why_refused(link, host, endpoint, credentials)


def _why_refused(link: socket.socket, host: str, endpoint: str, credentials: Credentials) -> tuple[str, bool]:
    context = ssl.create_default_context(cafile=str(credentials.directory / CA))
    context.load_cert_chain(credentials.directory / CERTIFICATE, credentials.directory / KEY)
    try:
        with context.wrap_socket(link, server_hostname=host.strip("[]")) as secured:
            secured.recv(1)  # with TLS 1.3 a server refuses a certificate after its own handshake is done
    except ssl.SSLCertVerificationError as error:
        what = _explained(error.verify_message)
        return f"the certificate of who listens at {endpoint} does not serve: {what}", True
    except ssl.SSLError as error:
        if "alert" in str(error).lower():
            return (
                f"who listens at {endpoint} refuses the certificate in {credentials.directory}: {_alert(error)}",
                True,
            )
        return f"what answers at {endpoint} speaks no TLS", False
    except OSError:
        pass
    return f"who listens at {endpoint} closed the connection", False


def _alert(error: ssl.SSLError) -> str:
    reason = (error.reason or str(error)).lower().replace("_", " ")
    return _explained(reason.partition("alert ")[2] or reason)


def _explained(reason: str) -> str:
    """What to do about a reason of OpenSSL's."""
    if "expired" in reason:
        return f"{reason}: issue it anew (daedalus certs issue)"
    if "issuer" in reason or "unknown ca" in reason or "self-signed" in reason or "decrypt error" in reason:
        return f"{reason}: the two are of different CAs (ca.pem must be the same on both sides)"
    if "mismatch" in reason:
        return f"{reason}: name the host when its certificate is issued (--host)"
    return reason


def _described(role: str, name: str) -> str:
    return f"{role} {name!r}" if name else role


def _verified_subject(directory: Path) -> str:
    """The common name of a certificate that fits its key, is valid now and signed by its CA.

    Found by a handshake with itself in memory: what fails there would fail on the network, without a word.
    """
    server = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    try:
        server.load_cert_chain(directory / CERTIFICATE, directory / KEY)
    except ssl.SSLError as error:
        if error.reason == "KEY_VALUES_MISMATCH":
            raise CredentialsError(f"{directory}: {KEY} is not the key of {CERTIFICATE}: copy both anew") from None
        raise CredentialsError(f"{directory}: {CERTIFICATE} or {KEY} is damaged: copy both anew") from None
    server.verify_mode = ssl.CERT_REQUIRED
    client = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
    client.check_hostname, client.verify_mode = False, ssl.CERT_NONE  # it is the client's that is looked at
    client.load_cert_chain(directory / CERTIFICATE, directory / KEY)
    try:
        server.load_verify_locations(directory / CA)
        certificate = _handshake(client, server)
    except ssl.SSLCertVerificationError as error:
        raise CredentialsError(f"{directory}: {CERTIFICATE}: {_explained(error.verify_message)}") from None
    except ssl.SSLError:
        raise CredentialsError(f"{directory}: {CA} is damaged: copy it anew") from None
    subject = {key: value for part in certificate.get("subject", ()) for key, value in part}
    return str(subject.get("commonName", ""))


def _handshake(client: ssl.SSLContext, server: ssl.SSLContext) -> dict[str, Any]:
    """The client's certificate, as the server verified it. Raises SSLError."""
    up, down = ssl.MemoryBIO(), ssl.MemoryBIO()
    ends = [client.wrap_bio(down, up), server.wrap_bio(up, down, server_side=True)]
    for _ in range(4):  # as many messages as either side has to say, and more
        for end in ends:
            with contextlib.suppress(ssl.SSLWantReadError):
                end.do_handshake()
    return dict(ends[1].getpeercert() or {})
