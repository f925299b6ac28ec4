"""Certificate authorities, each in a folder: they create keys and sign certificates (X.509, P-256).

No other file imports `cryptography`.
"""

import datetime
import ipaddress
from dataclasses import dataclass
from pathlib import Path

from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID

from daedalus.policy.saving.regular_files import replacing
from daedalus.transport.credentials import CA, CERTIFICATE, KEY, CredentialsError

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
        self._directory, self._key = directory, key

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
