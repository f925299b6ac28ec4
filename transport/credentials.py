"""The folder given by `--tls`: a certificate, its key, and the CA of those that listen.

    ca.pem  certificate.pem  key.pem      created by `daedalus certs`
    clients.pem                           for a router or learner: the certificates of those that may connect

clients.pem holds ca.pem and one issuer for each authorised actor, operator, and learner of certain runs. The issuer's
common name is its identity, and the only certificate that it signs is that of this identity: without the issuer in
clients.pem, the certificate is worth nothing. Zenoh reports only that a link failed, so this file checks certificates
before they are used.
"""

import contextlib
import functools
import logging
import os
import ssl
import threading
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from daedalus.protocol import keys
from daedalus.transport.access_control import access_control, parse_common_name
from daedalus.transport.addresses import AddressError, check_connecting, check_listening
from daedalus.transport.certificate_expiry import Validity, expiry_watch

CA, CERTIFICATE, KEY, CLIENTS = "ca.pem", "certificate.pem", "key.pem", "clients.pem"

NO_CHECK_TIME = 0x200000  # X509_V_FLAG_NO_CHECK_TIME of OpenSSL, which the module ssl does not name

_logger = logging.getLogger(__name__)


class CredentialsError(Exception):
    """A folder of credentials that cannot be used; the message says why and what to do."""


class NotValidNowError(CredentialsError):
    """A certificate that has expired, or that is not valid yet by the clock of this host."""


@dataclass(frozen=True, slots=True)
class Credentials:
    """Verified credentials of one process: its role, and the name of an actor or operator."""

    directory: Path
    role: str  # learner, router, actor, operator
    name: str  # empty for a learner or router
    run: str = ""  # if it is for the runs RUN and RUN.anything only

    def settings(self, *, listens: bool) -> dict[str, Any]:
        """Return Zenoh's settings for mutual TLS and, if the session listens, for access control.

        Raises CredentialsError if the session listens and clients.pem is not readable.
        """
        tls = "transport/link/tls"
        certificate, key = str(self.directory / CERTIFICATE), str(self.directory / KEY)
        settings: dict[str, Any] = {
            f"{tls}/root_ca_certificate": str(self.directory / (CLIENTS if listens else CA)),
            f"{tls}/enable_mtls": True,
            f"{tls}/connect_certificate": certificate,
            f"{tls}/connect_private_key": key,
            f"{tls}/close_link_on_expiration": True,
        }
        if listens:
            settings[f"{tls}/listen_certificate"], settings[f"{tls}/listen_private_key"] = certificate, key
            settings["access_control"] = access_control(authorised_clients(self.directory))
        return settings

    def hosts(self) -> list[str]:
        """Return the names and addresses of hosts that the certificate is for. Raises CredentialsError."""
        names = _verified(self.directory, ignore_time=True).get("subjectAltName", ())
        return [str(value) for kind, value in names if kind in ("DNS", "IP Address")]

    def validity(self) -> Validity:
        """Return from when to when the certificate that is in the folder now is valid.

        Raises CredentialsError if it is not readable.
        """
        return _validity(self.directory)

    def watch_expiry(self) -> None:
        """Log a warning before the certificate expires and once it has expired, now and from now on."""
        expiry_watch().add(self.directory, lambda: _readable_validity(self))

    def check_valid_now(self) -> None:
        """Raise NotValidNowError if the certificate that is in the folder now is not valid by the clock of this host.

        Raises CredentialsError if it is not readable.
        """
        if fault := self.validity().fault():
            raise NotValidNowError(f"{self.directory}: the certificate {fault}")


def load(directory: Path, *roles: str) -> Credentials:
    """Return the verified credentials in a folder.

    Raises NotValidNowError, or CredentialsError if a file is missing or damaged, the certificate is not signed by the
    CA, or its role is not one of `roles`.
    """
    subject = common_name_of(_verified(directory))
    role, name, run = parse_common_name(subject)
    if role not in roles:
        raise CredentialsError(
            f"{directory} holds the certificate of {_described(role, name)}, but {' or '.join(roles)} is required: "
            f"name the folder of such a certificate, or issue one (daedalus certs issue {roles[0]})"
        )
    # It is read again later, when the code of a user may have changed the working directory.
    return Credentials(Path(os.path.abspath(directory)), role, name, run)


def authorised_clients(directory: Path) -> list[str]:
    """Return the common names of the actors, operators and learners of certain runs in clients.pem.

    Raises CredentialsError if it is not readable.
    """
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    try:
        context.load_verify_locations(directory / CLIENTS)
    except (OSError, ssl.SSLError):
        raise CredentialsError(f"{directory} has no readable {CLIENTS}: create it with `daedalus certs`") from None
    names = map(common_name_of, context.get_ca_certs())
    return sorted(name for name in names if name.partition(":")[0] in ("actor", "operator", "learner"))


def run_for(credentials: Credentials | None, run: str) -> str:
    """Return the run to take part in or to watch: of a certificate that is for certain runs, it is one of these.

    `run` is the user's choice, or `*`. Raises CredentialsError if the certificate is for other runs.
    """
    if credentials is None or not credentials.run or keys.owner(run) == credentials.run:
        return run
    if run == keys.ANY_RUN:
        return credentials.run
    raise CredentialsError(
        f"the certificate in {credentials.directory} is not for the run {run!r}, only for {credentials.run!r} and "
        f"{credentials.run}.ANYTHING: rename the run, or use another certificate (daedalus certs issue)"
    )


def common_name_of(certificate: dict[str, Any]) -> str:
    """Return the common name of a certificate as the module ssl describes it."""
    subject = {key: value for part in certificate.get("subject", ()) for key, value in part}
    return str(subject.get("commonName", ""))


def is_about_time(reason: str) -> bool:
    """Return whether OpenSSL or an alert of the other end refuses a certificate by the clock."""
    return "expired" in reason or "not yet valid" in reason


def with_remedy(reason: str) -> str:
    """Return a reason given by OpenSSL, with what to do about it."""
    if "expired" in reason:
        return f"{reason}: renew it (daedalus certs renew)"
    if "issuer" in reason or "unknown ca" in reason or "self-signed" in reason or "decrypt error" in reason:
        return f"{reason}: the two ends use different CAs (ca.pem must be the same on both sides)"
    if "not yet valid" in reason:
        return f"{reason}: check the clock of this host, and of the host that issued it"
    if "mismatch" in reason:
        return f"{reason}: issue the certificate for this host (--host)"
    return reason


def _described(role: str, name: str) -> str:
    return f"{role} {name!r}" if name else role


def validity_of(certificate: dict[str, Any]) -> Validity:
    """Return the validity of a certificate as the module ssl describes it."""
    begins, ends = (ssl.cert_time_to_seconds(str(certificate[key])) for key in ("notBefore", "notAfter"))
    return Validity(begins, ends)


def _validity(directory: Path) -> Validity:
    try:
        return _read_validity(directory, (directory / CERTIFICATE).stat().st_mtime_ns)
    except OSError:
        raise CredentialsError(
            f"{directory} has no {CERTIFICATE}: copy the folder again, unless `daedalus certs revoke` has removed it"
        ) from None


def _readable_validity(credentials: Credentials | None) -> Validity | None:
    """Return the validity of a certificate, or None without one, or while it is being replaced."""
    with contextlib.suppress(CredentialsError):
        return None if credentials is None else credentials.validity()
    return None


@functools.lru_cache(maxsize=16)
def _read_validity(directory: Path, _modified: int) -> Validity:
    return validity_of(_verified(directory, ignore_time=True))


def _verified(directory: Path, *, ignore_time: bool = False) -> dict[str, Any]:
    """Return the description of a certificate that fits its key, is valid now and is signed by its CA.

    Verifies by a TLS handshake with itself in memory: on the network the same failure would have no explanation.
    Raises CredentialsError.
    """
    for name in (CA, CERTIFICATE, KEY):
        _check_readable(directory / name)
    server = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    try:
        server.load_cert_chain(directory / CERTIFICATE, directory / KEY)
    except ssl.SSLError as error:
        if error.reason == "KEY_VALUES_MISMATCH":
            raise CredentialsError(f"{directory}: {KEY} is not the key of {CERTIFICATE}: copy both again") from None
        raise CredentialsError(f"{directory}: {CERTIFICATE} or {KEY} is damaged: copy both again") from None
    server.verify_mode = ssl.CERT_REQUIRED
    if ignore_time:
        server.verify_flags |= NO_CHECK_TIME
    client = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
    client.check_hostname, client.verify_mode = False, ssl.CERT_NONE  # only the client's certificate is verified
    client.load_cert_chain(directory / CERTIFICATE, directory / KEY)
    try:
        server.load_verify_locations(directory / CA)
        server.load_verify_locations(directory / CERTIFICATE)  # with the issuer of an actor or operator
        return _handshake(client, server)
    except ssl.SSLCertVerificationError as error:
        if is_about_time(error.verify_message):
            fault = _validity(directory).fault()  # else a certificate of its CA is meant
            reason = f"the certificate {fault}" if fault else f"{CA}: {with_remedy(error.verify_message)}"
            raise NotValidNowError(f"{directory}: {reason}") from None
        raise CredentialsError(f"{directory}: {CERTIFICATE}: {with_remedy(error.verify_message)}") from None
    except ssl.SSLError:
        raise CredentialsError(f"{directory}: {CA} is damaged: copy it again") from None


def _check_readable(path: Path) -> None:
    try:
        if not path.is_file():  # to open a named pipe would wait for its writer
            raise CredentialsError(f"{path.parent} has no {path.name}: create such a folder with `daedalus certs`")
        path.open("rb").close()
    except OSError as error:
        raise CredentialsError(f"{path}: {error.strerror}: let the user of this process read it") from None


def _handshake(client: ssl.SSLContext, server: ssl.SSLContext) -> dict[str, Any]:
    """Return the client's certificate as the server verified it. Raises SSLError."""
    up, down = ssl.MemoryBIO(), ssl.MemoryBIO()
    ends = [client.wrap_bio(down, up), server.wrap_bio(up, down, server_side=True)]
    for _ in range(4):  # more rounds than a TLS handshake needs
        for end in ends:
            with contextlib.suppress(ssl.SSLWantReadError):
                end.do_handshake()
    return dict(ends[1].getpeercert() or {})


_POLL_SECONDS = 1.0


_Stamp = tuple[tuple[int, int, int] | None, ...]  # inode, time of change and size of each file; None if it is missing


class CredentialsWatch:
    """Watch of one folder, from `open` to `close`. Has its own thread."""

    def __init__(self, credentials: Credentials, on_change: Callable[[], None]) -> None:
        """Construct the watch.

        Args:
          credentials: the folder, and the role that its certificate must have.
          on_change: called when the files have changed and are valid.
        """
        self._credentials, self._on_change = credentials, on_change
        self._used = self._seen = self._stamp()
        self._closed = threading.Event()
        self._thread = threading.Thread(target=self._watch, name="credentials watch", daemon=True)

    def open(self) -> None:
        """Start the thread."""
        self._thread.start()

    def close(self) -> None:
        """Stop the thread. Does not wait for a change that is being applied."""
        self._closed.set()

    def _watch(self) -> None:
        while not self._closed.wait(_POLL_SECONDS):
            stamp = self._stamp()
            # Files that are still being copied differ from poll to poll.
            if stamp == self._seen and stamp != self._used:
                self._used = stamp
                self._apply()
            self._seen = stamp

    def _apply(self) -> None:
        folder = self._credentials.directory
        try:
            load(folder, self._credentials.role)
            clients = authorised_clients(folder)
        except CredentialsError as error:
            _logger.warning("the changed certificates are not used: %s", error)
            return
        self._on_change()
        _logger.info(
            "certificates in %s have changed: %d actors and %d operators are authorised; all connections are renewed",
            folder,
            *(sum(client.startswith(f"{role}:") for client in clients) for role in ("actor", "operator")),
        )

    def _stamp(self) -> _Stamp:
        return tuple(map(self._stamp_of, (CA, CERTIFICATE, KEY, CLIENTS)))

    def _stamp_of(self, name: str) -> tuple[int, int, int] | None:
        try:
            found = (self._credentials.directory / name).stat()
        except OSError:
            return None
        return found.st_ino, found.st_mtime_ns, found.st_size


SECURITY_ERRORS = (AddressError, CredentialsError)


def credentials_to_listen(endpoints: list[str], tls: Path | None, role: str, *, insecure: bool) -> Credentials | None:
    """Return the certificate to listen with, or None without `tls`. Raises one of SECURITY_ERRORS."""
    check_listening(endpoints, tls=tls is not None, insecure=insecure)
    if tls is None:
        return None
    credentials = load(tls, role)
    if credentials.run:
        raise CredentialsError(
            f"{tls} holds the certificate of a learner for the run {credentials.run!r} only, which may not listen: "
            "start a router (daedalus router), and use --connect"
        )
    return credentials


def credentials_to_connect(endpoints: list[str], tls: str | Path | None, *roles: str) -> Credentials | None:
    """Return the certificate to connect with, or None without `tls`. Raises one of SECURITY_ERRORS."""
    check_connecting(endpoints, tls=tls is not None)
    return None if tls is None else load(Path(tls), *roles)


def certificate_days_left(credentials: Credentials | None) -> float | None:
    """Return the days until a certificate expires, or None without one, or while it is being replaced."""
    validity = _readable_validity(credentials)
    return None if validity is None else validity.days_left()
