"""The folder of `daedalus certs`: the certificate authority (CA), one folder for each identity, and tokens of clients.

    ca/ca.pem, ca/key.pem            the CA that signs the certificates of learner and router
    ca/gateway/ca.pem, key.pem       the CA that signs the certificates of gateways, for clients and browsers
    ca/actor-NAME/ca.pem, key.pem    the issuer of this actor's certificates; operators likewise
    ca/IDENTITY/certificate.pem      a copy of the certificate that was issued last
    learner/, router/, gateway/, actor-NAME/    what the process of this identity needs: see transport/credentials.py
    ca/tokens.json         what is kept of each token: its digest and when it expires
    gateway/tokens.json    a copy for the gateway, which reads it again when it changes
    client-NAME/           token, and ca.pem of the gateways, for the client
    operator-NAME/         token, beside the operator's certificate

An issuer of its own for each client makes revocation possible: without the issuer in clients.pem, no listener accepts
the certificate. A gateway has another CA than the learner: actors accept every certificate of the learner's CA that is
valid for the host they connect to, so a gateway on that host could otherwise pass as the learner. No other file imports
`cryptography`.
"""

import datetime
import ipaddress
import json
import shutil
import socket
import time
from dataclasses import dataclass, field, replace
from pathlib import Path

from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID

from daedalus.gateway.security import OPERATOR, TOKENS, digest, new_token
from daedalus.policy.saving.regular_files import replace_text, replacing
from daedalus.protocol import keys
from daedalus.transport.access_control import common_name, parse_common_name
from daedalus.transport.credentials import CA, CERTIFICATE, CLIENTS, KEY, Credentials, CredentialsError
from daedalus.transport.zenoh_settings import Capacity, as_config_file, session_settings

_HOSTS = x509.SubjectAlternativeName
_CLOCK_SKEW = datetime.timedelta(hours=1)  # allowed between the clocks of two hosts


class CertificateAuthority:
    """Certificate authority (CA) whose certificate and key are in one folder."""

    def __init__(self, directory: Path) -> None:
        """Read the CA. Raises CredentialsError if the folder holds none."""
        try:
            self._certificate = x509.load_pem_x509_certificate((directory / CA).read_bytes())
            key = serialization.load_pem_private_key((directory / KEY).read_bytes(), None)
        except (OSError, ValueError):
            raise CredentialsError(f"{directory} holds no CA: create one with `daedalus certs init`") from None
        if not isinstance(key, ec.EllipticCurvePrivateKey):
            raise CredentialsError(
                f"{directory / KEY} is not an elliptic-curve key: create a CA with `daedalus certs init`"
            )
        self._key = key

    @classmethod
    def create(cls, directory: Path, common_name: str, lifetime: datetime.timedelta) -> "CertificateAuthority":
        """Create a CA with a name in a folder that holds none. The certificate is written last."""
        key = ec.generate_private_key(ec.SECP256R1())
        name = _x509_name(common_name)
        builder = _builder(name, name, key, lifetime).add_extension(x509.BasicConstraints(True, 0), critical=True)
        builder = builder.add_extension(_usage(signs_certificates=True), critical=True)
        directory.mkdir(parents=True, exist_ok=True)
        _write(directory / KEY, _pem(key))
        _write(directory / CA, builder.sign(key, hashes.SHA256()).public_bytes(serialization.Encoding.PEM))
        return cls(directory)

    def issue(self, folder: Path, common_name: str, hosts: list[str], lifetime: datetime.timedelta) -> None:
        """Write a key and its certificate, followed by that of this CA, into a folder.

        With `hosts`, the certificate is for listening at these names and addresses too.
        """
        key = ec.generate_private_key(ec.SECP256R1())
        purposes = [ExtendedKeyUsageOID.CLIENT_AUTH, *([ExtendedKeyUsageOID.SERVER_AUTH] if hosts else [])]
        builder = _builder(_x509_name(common_name), self._certificate.subject, key, lifetime)
        builder = builder.add_extension(x509.BasicConstraints(False, None), critical=True)
        builder = builder.add_extension(_usage(signs_certificates=False), critical=True)
        builder = builder.add_extension(x509.ExtendedKeyUsage(purposes), critical=False)
        builder = builder.add_extension(
            x509.AuthorityKeyIdentifier.from_issuer_public_key(self._key.public_key()), critical=False
        )
        if hosts:
            builder = builder.add_extension(_HOSTS([_alternative_name(h) for h in hosts]), False)
        certificate = builder.sign(self._key, hashes.SHA256())
        folder.mkdir(parents=True, exist_ok=True)
        _write(folder / KEY, _pem(key))
        chain = [each.public_bytes(serialization.Encoding.PEM) for each in (certificate, self._certificate)]
        _write(folder / CERTIFICATE, b"".join(chain))


@dataclass(frozen=True, slots=True)
class Issued:
    """What a certificate states."""

    common_name: str
    expires: datetime.datetime
    hosts: list[str]  # names and addresses for which it may listen

    @property
    def days_left(self) -> float:
        """Days until it expires; negative if it has expired."""
        return (self.expires - datetime.datetime.now(datetime.UTC)) / datetime.timedelta(days=1)


def read_issued(path: Path) -> Issued:
    """Return what the certificate in a file states. Raises CredentialsError."""
    try:
        certificate = x509.load_pem_x509_certificate(path.read_bytes())
    except (OSError, ValueError):
        raise CredentialsError(f"{path} is not a certificate: issue it again") from None
    (name,) = certificate.subject.get_attributes_for_oid(NameOID.COMMON_NAME)
    try:
        hosts = [str(host.value) for host in certificate.extensions.get_extension_for_class(_HOSTS).value]
    except x509.ExtensionNotFound:
        hosts = []
    return Issued(str(name.value), certificate.not_valid_after_utc, hosts)


def _builder(
    subject: x509.Name, issuer: x509.Name, key: ec.EllipticCurvePrivateKey, lifetime: datetime.timedelta
) -> x509.CertificateBuilder:
    now = datetime.datetime.now(datetime.UTC)
    return (
        x509.CertificateBuilder()
        .subject_name(subject)
        .issuer_name(issuer)
        .public_key(key.public_key())
        .serial_number(x509.random_serial_number())
        .not_valid_before(min(now, now + lifetime) - _CLOCK_SKEW)
        .not_valid_after(now + lifetime)
        .add_extension(x509.SubjectKeyIdentifier.from_public_key(key.public_key()), critical=False)
    )


def _x509_name(common_name: str) -> x509.Name:
    return x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, common_name)])


def _alternative_name(host: str) -> x509.GeneralName:
    try:
        return x509.IPAddress(ipaddress.ip_address(host))
    except ValueError:
        return x509.DNSName(host)


def _usage(*, signs_certificates: bool) -> x509.KeyUsage:
    return x509.KeyUsage(
        digital_signature=not signs_certificates,
        content_commitment=False,
        key_encipherment=False,
        data_encipherment=False,
        key_agreement=False,
        key_cert_sign=signs_certificates,
        crl_sign=signs_certificates,
        encipher_only=False,
        decipher_only=False,
    )


def _pem(key: ec.EllipticCurvePrivateKey) -> bytes:
    return key.private_bytes(
        serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8, serialization.NoEncryption()
    )


def _write(path: Path, data: bytes) -> None:
    with replacing(path, private=True) as beside:
        beside.write_bytes(data)


_DAY = 86_400.0


class ClientTokens:
    """The tokens of one network."""

    def __init__(self, directory: Path) -> None:
        """`directory` is a folder that `daedalus certs init` made."""
        self.directory = directory
        self._record = directory / "ca" / TOKENS

    def days_left(self) -> dict[str, float]:
        """Return the days until each client's token expires, by name."""
        now = time.time()
        clients = {name: entry for name, entry in self._read().items() if not name.startswith(OPERATOR)}
        return {name: (entry["expires"] - now) / _DAY for name, entry in clients.items()}

    def issue(self, names: list[str], days: int) -> None:
        """Issue tokens, new or in place of those before. Raises ValueError or CredentialsError for a wrong name."""
        for name in names:
            keys.check_name(name, "client name")
            if "." in name:
                raise CredentialsError(f"{name!r} has a '.': a token for NAME is valid for NAME.ANYTHING too")
        for name in names:
            folder = self.directory / f"client-{name}"
            folder.mkdir(exist_ok=True)
            shutil.copyfile(self.directory / "ca" / "gateway" / CA, folder / CA)
        self._issue({name: f"client-{name}" for name in names}, days)

    def issue_operators(self, folders: dict[str, str], days: int) -> None:
        """Issue tokens of operators, into the folders of their certificates, by name."""
        self._issue({OPERATOR + name: folder for name, folder in folders.items()}, days)

    def revoke_operators(self, names: list[str]) -> None:
        """Withdraw the tokens of operators whose certificates are revoked."""
        known = self._read()
        for name in names:
            known.pop(OPERATOR + name, None)
        self._write(known)

    def _issue(self, folders: dict[str, str], days: int) -> None:
        """Write new tokens into folders, by the name that is kept."""
        known = self._read()
        for name, folder in folders.items():
            token = new_token()
            known[name] = {"sha256": digest(token), "expires": time.time() + days * _DAY}
            replace_text(self.directory / folder / "token", token + "\n", private=True)
        self._write(known)

    def revoke(self, names: list[str]) -> None:
        """Withdraw tokens. Raises CredentialsError if one is not known."""
        known = self._read()
        unknown = [name for name in names if name not in known]
        if unknown:
            raise CredentialsError(f"no client is named {', '.join(unknown)}: see `daedalus certs list`")
        for name in names:
            del known[name]
            shutil.rmtree(self.directory / f"client-{name}", ignore_errors=True)
        self._write(known)

    def copy_to_gateway(self) -> None:
        """Write the gateway's copy, if the folder has a gateway."""
        if (self.directory / "gateway").exists():
            replace_text(self.directory / "gateway" / TOKENS, json.dumps(self._read(), indent=2) + "\n", private=True)

    def _read(self) -> dict[str, dict]:
        return json.loads(self._record.read_text("utf-8")) if self._record.exists() else {}

    def _write(self, known: dict[str, dict]) -> None:
        replace_text(self._record, json.dumps(known, indent=2) + "\n", private=True)
        self.copy_to_gateway()


LISTENERS = ("learner", "router", "gateway")
_ZENOH_LISTENERS = ("learner", "router")
_MAX_COMMON_NAME = 64  # of X.509

_CA_LIFETIME = datetime.timedelta(days=3650)
_ZENOHD = "zenoh.json5"
# A listener names all issuers in each handshake, which has room for 65,535 bytes: about 2,000 names.
_MAX_SUBJECT_BYTES, _SUBJECT_OVERHEAD = 60_000, 16


@dataclass(frozen=True, slots=True, order=True)
class Identity:
    """Who a certificate is for."""

    role: str
    name: str = ""  # of an actor or operator; of a learner, the run that it is for
    run: str = field(default="", compare=False)  # of an actor or operator that is for certain runs

    @classmethod
    def of(cls, text: str) -> "Identity":
        """Return the identity that a common name stands for."""
        role, name, run = parse_common_name(text)
        return cls(role, run) if role == "learner" else cls(role, name, run)

    @property
    def listens(self) -> bool:
        """Whether the certificate is for listening."""
        return self.role in LISTENERS and not self.name

    @property
    def folder(self) -> str:
        """Name of the folder of this identity."""
        if self.name and (self.name != self.role or self.role == "learner"):
            return f"{self.role}-{self.name}"
        return self.role

    @property
    def common_name(self) -> str:
        """Common name in the certificate."""
        return common_name(self.role, self.name, self.name if self.role == "learner" else self.run)


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
            found[Identity.of(issued.common_name)] = issued
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
        known = {identity: identity for identity in self.identities()}
        for identity in identities:
            before = known.get(identity, identity)
            identity = replace(identity, run=identity.run or before.run)
            record, folder = self.directory / "ca" / identity.folder, self.directory / identity.folder
            if before.run != identity.run:
                shutil.rmtree(record)  # the issuer has the run in its name
            if identity.listens and identity.role != "gateway":
                authority = self._ca
                record.mkdir(exist_ok=True)
            else:
                authority = self._issuer(record, identity)
            for_hosts = self._hosts(identity, hosts) if identity.listens else []
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
            if not identity.listens
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
    clients = [identity for identity in identities if not identity.listens]
    if sum(len(client.common_name) + _SUBJECT_OVERHEAD for client in clients) > _MAX_SUBJECT_BYTES:
        raise CredentialsError(
            f"{len(clients)} certificates are more than a listener can accept: issue one for each host, whose actors "
            "use it under NAME.1, NAME.2 and so on, and revoke those that are not needed"
        )


def _check_name(identity: Identity) -> None:
    for name in filter(None, (identity.name, identity.run)):
        keys.check_name(name, f"{identity.role} name" if name == identity.name else "run")
        first, dot, _ = name.partition(".")
        if dot:
            raise CredentialsError(f"{name!r} has a '.': name it {first!r}, which may also act as {name!r}")
    if len(identity.common_name) > _MAX_COMMON_NAME:
        raise CredentialsError(
            f"the names are too long: {identity.common_name!r} has more than {_MAX_COMMON_NAME} characters"
        )
