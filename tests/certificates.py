"""Certificates for tests: a CA, and certificates for each role."""

import datetime
import shutil
from pathlib import Path

from daedalus.cli.commands.certs import certs
from daedalus.launch.certificates import CertificateAuthority
from daedalus.transport.access_control import common_name
from daedalus.transport.credentials import Credentials


def make_certificates(directory: Path) -> Path:
    """Create a CA and certificates with `daedalus certs`, with the actors arm and box; return the folder."""
    assert certs(["init", str(directory)]) == 0
    assert certs(["issue", "actor", "arm", "box", "--directory", str(directory)]) == 0
    return directory


def issue_expired(directory: Path, role: str, name: str = "") -> Path:
    """Create a folder whose certificate expired yesterday, and return it."""
    folder = directory / f"expired-{role}"
    hosts = [] if name else ["localhost", "127.0.0.1"]
    authority = CertificateAuthority(directory / "ca" / f"{role}-{name}" if name else directory / "ca")
    authority.issue(folder, common_name(role, name), hosts, -datetime.timedelta(days=1))
    shutil.copyfile(directory / "ca" / "ca.pem", folder / "ca.pem")
    shutil.copyfile(directory / "router" / "clients.pem", folder / "clients.pem")
    return folder


def unchecked(folder: Path, role: str = "actor", name: str = "arm") -> Credentials:
    """Return credentials whose files were not checked."""
    return Credentials(folder, role, name)
