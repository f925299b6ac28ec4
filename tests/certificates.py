"""Certificates for tests: a CA, and certificates for each role."""

import datetime
import shutil
from pathlib import Path

from daedalus.cli.commands.certs import certs
from daedalus.launch.certificates import CertificateAuthority
from daedalus.transport.access_control import common_name
from daedalus.transport.credentials import Credentials


def make_certificates(directory: Path, *issued: str) -> Path:
    """Create a CA with `daedalus certs`, and issue certificates, of the actors arm and box by default."""
    assert certs(["init", str(directory)]) == 0
    for words in issued or ("actor arm box",):
        change_certificates(directory, f"issue {words}")
    return directory


def change_certificates(directory: Path, words: str) -> None:
    """Run `daedalus certs WORDS` in a folder."""
    assert certs([*words.split(), "--directory", str(directory)]) == 0


def issue_expired(directory: Path, role: str, name: str = "", *, days: float = -1) -> Path:
    """Create a folder whose certificate expired yesterday, or expires in some days, and return it."""
    folder = directory / f"expired-{role}"
    hosts = [] if name else ["localhost", "127.0.0.1"]
    authority = CertificateAuthority(directory / "ca" / f"{role}-{name}" if name else directory / "ca")
    authority.issue(folder, common_name(role, name), hosts, datetime.timedelta(days=days))
    shutil.copyfile(directory / "ca" / "ca.pem", folder / "ca.pem")
    shutil.copyfile(directory / "router" / "clients.pem", folder / "clients.pem")
    return folder


def unchecked(folder: Path, role: str = "actor", name: str = "arm") -> Credentials:
    """Return credentials whose files were not checked."""
    return Credentials(folder, role, name)
