"""Test of `daedalus certs`."""

import datetime
import errno
import json
import shutil
import stat
from pathlib import Path

import pytest
from certificates import change_certificates

from daedalus.cli.commands.certs import certs
from daedalus.launch import certificates
from daedalus.transport.credentials import authorised_clients, load


def make(directory: Path) -> Path:
    assert certs(["init", str(directory), "--host", "gpu-box"]) == 0
    return directory


def test_init_creates_a_ca_and_certificates_for_learner_router_and_operator(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    made = make(tmp_path / "certs")
    assert sorted(entry.name for entry in made.iterdir()) == ["ca", "learner", "operator", "router"]
    for role in ("learner", "router", "operator"):
        assert load(made / role, role).role == role
    assert "valid for gpu-box, " in capsys.readouterr().out


def test_a_key_file_is_readable_by_its_owner_only(tmp_path: Path) -> None:
    for key in make(tmp_path / "certs").rglob("key.pem"):
        assert stat.S_IMODE(key.stat().st_mode) == 0o600


def test_issue_and_revoke_update_the_authorised_clients_of_learner_and_router(tmp_path: Path) -> None:
    made = make(tmp_path / "certs")
    assert certs(["issue", "actor", "arm", "box", "--directory", str(made)]) == 0
    assert certs(["issue", "operator", "ann", "--directory", str(made)]) == 0
    credentials = load(made / "actor-arm", "actor")
    assert (credentials.role, credentials.name) == ("actor", "arm")
    for role in ("learner", "router"):
        assert authorised_clients(made / role) == ["actor:arm", "actor:box", "operator:ann", "operator:operator"]
    zenohd = json.loads((made / "router" / "zenoh.json5").read_text())
    assert {"actor:arm", "actor:box"} < {
        name for subject in zenohd["access_control"]["subjects"] for name in subject.get("cert_common_names", ())
    }
    assert certs(["revoke", "actor", "box", "--directory", str(made)]) == 0
    assert "actor:arm" in authorised_clients(made / "learner")
    assert not (made / "actor-box").exists()


def test_issue_that_was_interrupted_succeeds_when_it_is_repeated(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = make(tmp_path / "certs")
    with monkeypatch.context() as broken:
        broken.setattr(certificates, "_pem", _disk_full)
        assert certs(["issue", "actor", "arm-1", "--directory", str(folder)]) == 1
    assert (folder / "ca" / "actor-arm-1").exists()
    assert certs(["issue", "actor", "arm-1", "--directory", str(folder)]) == 0, capsys.readouterr().err
    assert "actor:arm-1" in authorised_clients(folder / "learner")


def _disk_full(_key: object) -> bytes:
    raise OSError(errno.ENOSPC, "No space left on device")


def test_an_actor_may_have_the_name_of_a_role(tmp_path: Path) -> None:
    made = make(tmp_path / "certs")
    assert certs(["issue", "actor", "learner", "operator", "--directory", str(made)]) == 0
    assert load(made / "actor-learner", "actor").name == "learner"
    assert load(made / "learner", "learner").role == "learner"


def test_issue_prints_the_folders_that_it_writes(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """An actor named `actor` has the folder `actor`, without its name twice."""
    made = make(tmp_path / "certs")
    capsys.readouterr()
    assert certs(["issue", "actor", "actor", "arm", "--directory", str(made)]) == 0
    printed = [Path(line.split()[0]) for line in capsys.readouterr().out.splitlines() if line.startswith(str(made))]
    assert printed == [made / "actor", made / "actor-arm"]
    assert all((folder / "key.pem").is_file() for folder in printed)


def test_list_shows_when_each_certificate_expires(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    made = make(tmp_path / "certs")
    assert certs(["issue", "actor", "arm", "--days", "29", "--directory", str(made)]) == 0
    shutil.rmtree(made / "actor-arm")  # moved to its host
    capsys.readouterr()
    assert certs(["list", "--directory", str(made)]) == 0
    header, first, *others = capsys.readouterr().out.splitlines()
    assert header.split() == ["certificate", "expires", "days"]
    expires = datetime.datetime.now(datetime.UTC) + datetime.timedelta(days=29)
    assert first.split(None, 3) == ["actor-arm", f"{expires:%Y-%m-%d}", "28", "renew it soon"]
    # Sorted by when they expire, to the second: those that were issued in one second are in the order of their names.
    assert sorted(line.split()[0] for line in others) == ["learner", "operator", "router"]
    assert all(line.split()[2] == "824" for line in others)


def test_renew_replaces_certificates_that_expire_soon(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    made = make(tmp_path / "certs")
    renew = ["renew", "--directory", str(made)]
    assert certs(renew) == 0
    assert capsys.readouterr().out.endswith("no certificate expires within 30 days\n")
    assert certs(["issue", "actor", "arm", "box", "--days", "20", "--directory", str(made)]) == 0
    assert certs(["issue", "router", "--host", "far", "--days", "20", "--directory", str(made)]) == 0
    clients = (made / "learner" / "clients.pem").read_bytes()
    assert certs(renew) == 0
    days = {folder: load(made / folder, role).validity().days_left() for folder, role in ROLES.items()}
    assert all(days[folder] > 800 for folder in ROLES)
    assert "valid for far, " in capsys.readouterr().out  # the hosts stay
    assert (made / "learner" / "clients.pem").read_bytes() == clients  # nothing to copy to the listeners
    assert certs([*renew, "actor", "arm", "--days", "7"]) == 0
    assert load(made / "actor-arm", "actor").validity().days_left() < 8
    assert load(made / "actor-box", "actor").validity().days_left() > 800
    assert certs([*renew, "actor", "--days", "6"]) == 0
    assert load(made / "actor-box", "actor").validity().days_left() < 7


def test_renew_replaces_tokens_that_expire_soon(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    made = make(tmp_path / "certs")
    for name, days in (("phone", "20"), ("robot", "90")):
        assert certs(["issue", "client", name, "--days", days, "--directory", str(made)]) == 0
    before = {name: (made / f"client-{name}" / "token").read_text() for name in ("phone", "robot")}
    capsys.readouterr()
    assert certs(["renew", "--directory", str(made)]) == 0
    assert "client-phone/token    give this token to the client" in capsys.readouterr().out
    assert (made / "client-phone" / "token").read_text() != before["phone"]
    assert (made / "client-robot" / "token").read_text() == before["robot"]
    assert certs(["renew", "--directory", str(made)]) == 0
    assert capsys.readouterr().out == "no certificate or token expires within 30 days\n"


ROLES = {"actor-arm": "actor", "actor-box": "actor", "router": "router", "learner": "learner"}


def test_more_certificates_than_a_handshake_has_room_for_are_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    made = make(tmp_path / "certs")
    monkeypatch.setattr(certificates, "_MAX_SUBJECT_BYTES", 60)
    assert certs(["issue", "actor", "arm", "--directory", str(made)]) == 0
    assert certs(["issue", "actor", "box", "--directory", str(made)]) == 1
    assert not (made / "actor-box").exists()
    assert "3 certificates are more than a listener can accept: issue one for each host" in capsys.readouterr().err
    assert "actor:arm" in authorised_clients(made / "learner")


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["init", "{certs}"], "is not empty"),
        (["issue", "actor", "--directory", "{certs}"], "wrong number of names"),
        (["issue", "router", "x", "--directory", "{certs}"], "wrong number of names"),
        (["issue", "actor", "a.b", "--directory", "{certs}"], "'a.b' has a '.': name it 'a'"),
        (["issue", "actor", "a/b", "--directory", "{certs}"], "actor name 'a/b' must be"),
        (["issue", "actor", "a", "--directory", "{certs}/nowhere"], "holds no CA"),
        (["init", "{certs}/new", "--host", "gpü-box"], "--host 'gpü-box' is not a name for a certificate"),
        (["issue", "router", "--host", "gpü-box", "--directory", "{certs}"], "--host 'gpü-box' is not a name"),
        (["issue", "gateway", "--host", "", "--directory", "{certs}"], "--host '' is not a name"),
        (["revoke", "actor", "a", "--directory", "{certs}"], "no actor is named a: see `daedalus certs list`"),
        (["renew", "actor", "a", "--directory", "{certs}"], "no certificate was issued for actor-a"),
        (["list", "--directory", "{certs}/nowhere"], "holds no CA"),
    ],
)
def test_a_mistake_is_reported_in_one_line_and_changes_no_file(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], arguments: list[str], message: str
) -> None:
    made = make(tmp_path / "certs")
    before = sorted(made.rglob("*"))
    assert certs([argument.format(certs=made) for argument in arguments]) == 1
    error = capsys.readouterr().err
    assert message in error
    assert error.count("\n") == 1
    assert sorted(made.rglob("*")) == before


def test_certificates_of_one_run_keep_their_run_and_have_no_token_for_gateways(tmp_path: Path) -> None:
    made = make(tmp_path / "certs")
    change_certificates(made, "issue learner alice")
    change_certificates(made, "issue actor rob --run alice")
    change_certificates(made, "issue operator ann --run alice")
    scoped = {"actor:rob@alice", "learner:alice", "operator:ann@alice"}
    assert scoped <= set(authorised_clients(made / "router"))
    assert [load(made / f"{role}-{name}", role).run for role, name in (("actor", "rob"), ("learner", "alice"))] == [
        "alice",
        "alice",
    ]
    assert not (made / "operator-ann" / "token").exists()
    change_certificates(made, "issue actor rob")  # a new one, for the same run
    change_certificates(made, "renew actor")
    change_certificates(made, "renew operator ann")
    assert scoped <= set(authorised_clients(made / "router"))
    assert not (made / "operator-ann" / "token").exists()
    change_certificates(made, "issue actor rob --run bob")
    change_certificates(made, "revoke learner alice")
    assert scoped & set(authorised_clients(made / "router")) == {"operator:ann@alice"}
    assert certs(["issue", "client", "c", "--run", "alice", "--directory", str(made)]) == 1
    assert certs(["issue", "actor", "a" * 40, "--run", "b" * 40, "--directory", str(made)]) == 1
