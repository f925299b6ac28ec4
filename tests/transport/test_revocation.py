"""A listener applies changed certificates without a restart: revoked ones are refused, new ones accepted."""

import datetime
import shutil
import threading
import time
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path

import pytest
from certificates import make_certificates
from log_lines import LINES
from processes import LIMIT, until
from routers import listen_somewhere

from daedalus.launch.certificates import CertificateFolder, Identity
from daedalus.protocol import keys
from daedalus.transport import certificate_expiry, credentials
from daedalus.transport.certificate_expiry import ExpiryWatch, Validity
from daedalus.transport.credentials import CredentialsError, load
from daedalus.transport.interface import RefusedError, Request, Transport, TransportError
from daedalus.transport.zenoh_transport import connect

DAYS = datetime.timedelta(days=365)
ARM, BOX, LATE = (Identity("actor", name) for name in ("arm", "box", "late"))


@pytest.fixture(autouse=True)
def _poll_often(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(credentials, "_POLL_SECONDS", 0.05)


@pytest.fixture
def folder(tmp_path: Path) -> CertificateFolder:
    return CertificateFolder(make_certificates(tmp_path / "certs"))


@pytest.fixture
def address(folder: CertificateFolder) -> Iterator[str]:
    """Run a router that answers joins itself."""
    where, router = listen_somewhere(folder.directory / "router")
    router.serve(keys.join("r", "*"), lambda request: request.reply(b"welcome"))
    with closing(router):
        yield where


def client(address: str, folder: CertificateFolder, identity: Identity) -> Transport:
    return connect([address], load(folder.directory / identity.folder, identity.role))


def answered(end: Transport, name: str = "arm") -> bool:
    """Return whether the router answers an actor that joins with its own name."""
    return end.query(keys.join("r", name), timeout=LIMIT) == [b"welcome"]


def test_revoked_certificate_loses_its_session_and_gets_no_other(address: str, folder: CertificateFolder) -> None:
    kept = folder.directory / "kept"
    shutil.copytree(folder.directory / ARM.folder, kept)
    with closing(connect([address], load(kept, "actor"))) as arm, closing(client(address, folder, BOX)) as box:
        assert answered(arm)
        folder.revoke([ARM])
        until(lambda: not answered(arm))
        until(lambda: answered(box, "box"))
        with pytest.raises(RefusedError, match=r"refuses the certificate in .*kept: it was revoked"):
            arm.reopen()
        with pytest.raises(RefusedError, match="it was revoked"):
            connect([address], load(kept, "actor"))
        assert not answered(arm)
    # A new certificate of the same name does not make the revoked one valid again.
    folder.issue([ARM], DAYS)
    with closing(eventually(address, folder, ARM)) as arm:
        until(lambda: answered(arm))
    with pytest.raises(RefusedError, match="it was revoked"):
        connect([address], load(kept, "actor"))


def eventually(address: str, folder: CertificateFolder, identity: Identity) -> Transport:
    """Connect as soon as the router has read the changed certificates."""
    ends: list[Transport] = []

    def opened() -> bool:
        try:
            ends.append(client(address, folder, identity))
        except TransportError:
            return False
        return True

    until(opened)
    return ends[0]


def test_certificate_that_is_issued_later_is_accepted(address: str, folder: CertificateFolder) -> None:
    with closing(client(address, folder, BOX)) as box:
        folder.issue([LATE], DAYS)
        with closing(eventually(address, folder, LATE)) as late:
            until(lambda: answered(late, "late"))
            until(lambda: answered(box, "box"))
    assert any("3 actors and 1 operators are authorised; all connections are renewed" in line for line in LINES)


def test_renewed_certificates_are_used_by_listener_and_client(address: str, folder: CertificateFolder) -> None:
    """The listener's is used at once, a client's from its next connection on; the one before stays valid."""
    with closing(client(address, folder, ARM)) as arm:
        folder.issue([Identity("router"), ARM], DAYS)
        until(lambda: any("connections are renewed" in line for line in LINES))
        until(lambda: answered(arm))


def test_damaged_files_are_not_used(address: str, folder: CertificateFolder) -> None:
    with closing(client(address, folder, ARM)) as arm:
        (folder.directory / "router" / "clients.pem").write_text("half a fi")
        until(lambda: any("the changed certificates are not used: " in line for line in LINES))
        assert answered(arm)
        folder.revoke([BOX])
        until(lambda: any("1 actors and 1 operators are authorised" in line for line in LINES))
        until(lambda: answered(arm))


def test_requests_that_wait_while_the_session_is_renewed_do_no_harm(folder: CertificateFolder) -> None:
    """Their answers are lost; the sender asks again."""
    address, router = listen_somewhere(folder.directory / "router")
    waiting: list[Request] = []
    renewed = threading.Event()
    with closing(router), closing(client(address, folder, ARM)) as arm:
        key = keys.join("r", "arm")
        router.serve(key, lambda request: request.reply(b"welcome") if renewed.is_set() else hold(request))

        def hold(request: Request) -> None:
            waiting.append(request)

        arm.query_async(keys.join("r", "arm"), b"payload", timeout=LIMIT, on_answer=lambda _: None)
        until(lambda: waiting)
        folder.revoke([BOX])
        until(lambda: any("connections are renewed" in line for line in LINES))
        renewed.set()
        assert waiting[0].payload == b"payload"
        waiting[0].reply(b"late")
        until(lambda: answered(arm))


def test_closed_router_is_not_opened_again(folder: CertificateFolder) -> None:
    address, router = listen_somewhere(folder.directory / "router")
    router.close()
    folder.revoke([BOX])
    until(lambda: all(thread.name != "credentials watch" for thread in threading.enumerate()))
    with pytest.raises(Exception, match="nothing answers"):
        client(address, folder, ARM)


def test_a_warning_30_days_before_a_certificate_expires(
    folder: CertificateFolder, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A short-lived certificate warns only in its last third."""
    folder.issue([ARM], DAYS)
    folder.issue([LATE], datetime.timedelta(days=29))
    arm, late = (load(folder.directory / identity.folder, "actor").validity() for identity in (ARM, LATE))

    def warning(validity: Validity, days_later: float) -> str:
        with monkeypatch.context() as patch:
            now = time.time()
            patch.setattr(time, "time", lambda: now + days_later * 86_400)
            return validity.warning()[:10]

    assert [warning(arm, days) for days in (0, 334, 336, 366)] == ["", "", "expires in", "expired on"]
    assert [warning(late, days) for days in (0, 19, 20)] == ["", "", "expires in"]


def test_the_warning_is_repeated_and_expiry_is_said(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(certificate_expiry, "_MIN_PAUSE_SECONDS", 0.0)
    now = time.time()
    ExpiryWatch().add(Path("certs/router"), lambda: Validity(now - 7.0, now + 3.0))
    until(lambda: any("certs/router expired on" in line for line in LINES))
    assert sum("certs/router expires in" in line for line in LINES) >= 2


def test_client_whose_certificate_expires_in_use_is_told_so(address: str, folder: CertificateFolder) -> None:
    with closing(client(address, folder, ARM)) as arm:
        folder.issue([ARM], -datetime.timedelta(days=1))
        with pytest.raises(RefusedError, match=r"actor-arm: the certificate expired on .*: renew it"):
            arm.reopen()  # fails, with or without the router


def test_expiry_of_the_certificate_in_the_folder_is_checked(folder: CertificateFolder) -> None:
    arm = load(folder.directory / ARM.folder, "actor")
    arm.check_valid_now()
    folder.issue([ARM], -datetime.timedelta(days=1))
    assert -1.1 < arm.validity().days_left() < -0.9
    with pytest.raises(CredentialsError, match=r"actor-arm: the certificate expired on \d{4}-\d\d-\d\d"):
        arm.check_valid_now()
    folder.issue([ARM], DAYS)
    arm.check_valid_now()
