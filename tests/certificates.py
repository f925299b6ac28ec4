"""A CA of a test's own, with an identity of every kind."""

import datetime
from pathlib import Path

from daedalus.cli.certificate_authority import CertificateAuthority
from daedalus.cli.commands.certs import certs
from daedalus.transport.access_control import common_name
from daedalus.transport.credentials import Credentials


def make_certificates(directory: Path) -> Path:
    """What `daedalus certs` makes for the actors arm and box."""
    assert certs(["init", str(directory)]) == 0
    assert certs(["issue", "actor", "arm", "box", "--directory", str(directory)]) == 0
    return directory


def issue_expired(directory: Path, role: str, name: str = "") -> Path:
    """A folder like the others, whose certificate was good until yesterday."""
    folder = directory / f"expired-{role}"
    hosts = [] if name else ["localhost", "127.0.0.1"]
    authority = CertificateAuthority(directory / "ca")
    authority.issue(folder, common_name(role, name), hosts, -datetime.timedelta(days=1))
    (folder / "names.json").write_text('{"actors": ["arm", "box"], "operators": ["operator"]}')
    return folder


def unchecked(folder: Path, role: str = "actor", name: str = "arm") -> Credentials:
    """As somebody would use it who does not look at it first."""
    return Credentials(folder, role, name)
