"""The folder of `daedalus certs`: the CA, and one folder for each identity.

    ca/ca.pem, ca/key.pem            the CA that signs the certificates of learner and router
    ca/gateway/ca.pem, key.pem       the CA that signs the certificates of gateways, for clients and browsers
    ca/actor-NAME/ca.pem, key.pem    the issuer of this actor's certificates; operators likewise
    ca/IDENTITY/certificate.pem      a copy of the certificate that was issued last
    learner/, router/, gateway/, actor-NAME/    what the process of this identity needs: see transport/credentials.py

The tokens of a gateway's clients are in client_tokens.py.

An issuer of its own for each client makes revocation possible: without the issuer in clients.pem, no listener accepts
the certificate. A gateway has another CA than the learner: actors accept every certificate of the learner's CA that is
valid for the host they connect to, so a gateway on that host could otherwise pass as the learner. The file needs the
package `cryptography`.
"""

import datetime
import json
import shutil
import socket
from dataclasses import dataclass
from pathlib import Path

from daedalus.cli.certificate_authority import CertificateAuthority, Issued, read_issued
from daedalus.policy.saving.regular_files import replace_text
from daedalus.protocol import keys
from daedalus.transport.access_control import common_name
from daedalus.transport.credentials import CA, CERTIFICATE, CLIENTS, Credentials, CredentialsError
from daedalus.transport.zenoh_settings import Capacity, as_config_file, session_settings

LISTENERS = ("learner", "router", "gateway")
_ZENOH_LISTENERS = ("learner", "router")
CLIENT_ROLES = ("actor", "operator")

_CA_LIFETIME = datetime.timedelta(days=3650)
_ZENOHD = "zenoh.json5"
# A listener names all issuers in each handshake, which has room for 65,535 bytes: about 2,000 names.
_MAX_SUBJECT_BYTES, _SUBJECT_OVERHEAD = 60_000, 16


@dataclass(frozen=True, slots=True, order=True)
class Identity:
    """Who a certificate is for."""

    role: str
    name: str = ""  # of an actor or operator

    @property
    def folder(self) -> str:
        """Name of the folder of this identity."""
        return self.role if self.name in ("", self.role) else f"{self.role}-{self.name}"

    @property
    def common_name(self) -> str:
        """Common name in the certificate."""
        return common_name(self.role, self.name)


class CertificateFolder:
    """Certificates of one network."""

    def __init__(self, directory: Path) -> None:
        """Open a folder that `create` made. Raises CredentialsError if it holds no CA."""
        self.directory = directory
        self._ca = CertificateAuthority(directory / "ca")

    @classmethod
    def create(cls, directory: Path, hosts: list[str], lifetime: datetime.timedelta) -> "CertificateFolder":
        """Create the CAs, and certificates for learner, router and the operator `operator`, in an empty folder."""
        if directory.exists() and any(directory.iterdir()):
            raise CredentialsError(
                f"{directory} is not empty: add certificates with `daedalus certs issue`, or name a new folder"
            )
        _check_hosts(hosts)
        CertificateAuthority.create(directory / "ca", "Daedalus CA", _CA_LIFETIME)
        CertificateAuthority.create(directory / "ca" / "gateway", "Daedalus gateway CA", _CA_LIFETIME)
        made = cls(directory)
        made.issue([*map(Identity, _ZENOH_LISTENERS), Identity("operator", "operator")], lifetime, hosts)
        return made

    def identities(self) -> dict[Identity, Issued]:
        """Return the certificates that are in use, by identity."""
        found = {}
        for path in sorted((self.directory / "ca").glob(f"*/{CERTIFICATE}")):
            issued = read_issued(path)
            role, _, name = issued.common_name.partition(":")
            found[Identity(role, name)] = issued
        return found

    def issue(self, identities: list[Identity], lifetime: datetime.timedelta, hosts: list[str] | None = None) -> None:
        """Issue certificates, new or in place of those that the identities have.

        `hosts` are the names and addresses of the machine that a listener runs on; None keeps those of the
        certificate before. Raises CredentialsError or ValueError if a name is not possible.
        """
        for identity in identities:
            _check_name(identity)
        _check_hosts(hosts or [])
        _check_number({*self.identities(), *identities})
        for identity in identities:
            record, folder = self.directory / "ca" / identity.folder, self.directory / identity.folder
            if identity.role in _ZENOH_LISTENERS:
                authority = self._ca
                record.mkdir(exist_ok=True)
            else:
                authority = self._issuer(record, identity)
            for_hosts = self._hosts(identity, hosts) if identity.role in LISTENERS else []
            authority.issue(folder, identity.common_name, for_hosts, lifetime)
            shutil.copyfile((record if identity.role == "gateway" else self.directory / "ca") / CA, folder / CA)
            shutil.copyfile(folder / CERTIFICATE, record / CERTIFICATE)
        self._write_clients()

    def revoke(self, identities: list[Identity]) -> None:
        """Withdraw the authorisation of actors and operators. Raises CredentialsError if one is not known."""
        unknown = [identity for identity in identities if identity not in self.identities()]
        if unknown:
            names = ", ".join(sorted(identity.name for identity in unknown))
            raise CredentialsError(f"no {unknown[0].role} is named {names}: see `daedalus certs list`")
        for identity in identities:
            shutil.rmtree(self.directory / "ca" / identity.folder)
            shutil.rmtree(self.directory / identity.folder, ignore_errors=True)
        self._write_clients()

    def hosts(self, identity: Identity) -> list[str]:
        """Return the names and addresses at which a listener's certificate is valid."""
        return self.identities()[identity].hosts

    def _hosts(self, identity: Identity, hosts: list[str] | None) -> list[str]:
        known = self.identities()
        if hosts is None and identity in known:
            return known[identity].hosts
        own = [name for name in (socket.gethostname(),) if name.isascii()]
        return list(dict.fromkeys([*(hosts or []), *own, "localhost", "127.0.0.1", "::1"]))

    def _issuer(self, record: Path, identity: Identity) -> CertificateAuthority:
        """Return the issuer of a client's or gateway's certificates, which is created with the first certificate."""
        if (record / CA).exists():  # not where the creation was interrupted
            return CertificateAuthority(record)
        return CertificateAuthority.create(record, identity.common_name, _CA_LIFETIME)

    def _write_clients(self) -> None:
        """Write clients.pem for learner and router, and the configuration of a standard zenohd."""
        issuers = [
            self.directory / "ca" / identity.folder / CA
            for identity in sorted(self.identities())
            if identity.role in CLIENT_ROLES
        ]
        content = "".join(path.read_text("ascii") for path in (self.directory / "ca" / CA, *issuers))
        for role in _ZENOH_LISTENERS:
            if (self.directory / role).exists():
                replace_text(self.directory / role / CLIENTS, content)
        router = (self.directory / "router").resolve()
        if router.exists():
            security = Credentials(router, "router", "").settings(listens=True)
            zenohd = as_config_file(session_settings("router", ["tls/0.0.0.0:7447"], [], security, Capacity()))
            replace_text(router / _ZENOHD, json.dumps(zenohd, indent=2) + "\n")


def _check_hosts(hosts: list[str]) -> None:
    for host in hosts:
        if not host or not host.isascii():
            raise CredentialsError(
                f"--host {host!r} is not a name for a certificate: write it in the letters of ASCII, as DNS has it "
                "(a name such as `größe` begins with xn-- there)"
            )


def _check_number(identities: set[Identity]) -> None:
    clients = [identity for identity in identities if identity.role in CLIENT_ROLES]
    if sum(len(client.common_name) + _SUBJECT_OVERHEAD for client in clients) > _MAX_SUBJECT_BYTES:
        raise CredentialsError(
            f"{len(clients)} certificates are more than a listener can accept: issue one for each host, whose actors "
            "use it under NAME.1, NAME.2 and so on, and revoke those that are not needed"
        )


def _check_name(identity: Identity) -> None:
    if identity.role in LISTENERS:
        return
    keys.check_name(identity.name, f"{identity.role} name")
    first, dot, _ = identity.name.partition(".")
    if dot:
        raise CredentialsError(
            f"{identity.name!r} has a '.': name it {first!r}, which may also act as {identity.name!r}"
        )
