"""Test of learner, actors and status over TLS."""

import shutil
from collections.abc import Callable
from contextlib import closing
from pathlib import Path

import pytest
from certificates import change_certificates, make_certificates, unchecked
from processes import ENDLESS, PLAYING_SLOW, SLOW, Running, here, until

from daedalus.transport.zenoh_transport import listen

Start = Callable[..., Running]


@pytest.fixture
def certificates(tmp_path: Path) -> Path:
    return make_certificates(tmp_path / "certs")


@pytest.fixture
def tls(address: str) -> str:
    return address.replace("tcp/", "tls/")


def test_authorised_actors_of_other_machines_join_train_over_tls_until_an_operator_stops_it(
    start: Start, tls: str, certificates: Path, tmp_path: Path
) -> None:
    training = ("--listen", tls, "--tls", certificates / "learner", "--actors", 1, *ENDLESS, *SLOW)
    train = start("train", "cartpole", *training)
    train.expect("return .* actors 1")
    arm = start("actor", "--connect", tls, "--tls", certificates / "actor-arm", *PLAYING_SLOW)
    arm.expect(r"joined run .* as 'arm\.[\w-]+-\d+'")
    box = ("--connect", tls, "--tls", certificates / "actor-box", "--name", "box")
    start("actor", *box, *PLAYING_SLOW).expect("as 'box'")
    train.expect("actors 3")
    asking = ("status", "--connect", tls, "--quiet", "--tls")
    assert here(*asking, certificates / "actor-arm").status == 2
    until(lambda: here(*asking, certificates / "operator").status == 0)
    (run,) = (directory.name for directory in (tmp_path / "runs").iterdir())
    order = ("stop", run, "--connect", tls, "--tls")
    refused = here(*order, certificates / "actor-arm")
    assert refused.status == 2
    refused.expect("daedalus stop: .*actor-arm holds the certificate of actor 'arm', but operator or learner or router")
    stopped = here(*order, certificates / "operator")
    assert stopped.status == 0, stopped
    stopped.expect(f"run '{run}': checkpoint saved at ")
    assert train.wait() == 1
    train.expect("stopped by operator operator at .*; continue with: daedalus resume")


def test_certificates_are_revoked_and_issued_without_a_restart(start: Start, tls: str, certificates: Path) -> None:
    router = start("router", "--listen", tls, "--tls", certificates / "router")
    router.expect("listening")
    learner = start("learner", "cartpole", "--connect", tls, "--tls", certificates / "learner", *ENDLESS, *SLOW)
    shutil.copytree(certificates / "actor-arm", certificates / "kept")
    arm = start("actor", "--connect", tls, "--tls", certificates / "kept", *PLAYING_SLOW)
    box = start("actor", "--connect", tls, "--tls", certificates / "actor-box", *PLAYING_SLOW)
    for actor in (arm, box):
        actor.expect("joined run")
    change_certificates(certificates, "revoke actor arm")
    assert arm.wait() == 1
    arm.expect(r"the service at .* refuses the certificate in .*kept: it was revoked, or issued after")
    change_certificates(certificates, "issue actor late")
    router.expect("2 actors and 1 operators are authorised; all connections are renewed")
    trained = len(learner.lines)
    start("actor", "--connect", tls, "--tls", certificates / "actor-late", *PLAYING_SLOW).expect("joined run")
    until(lambda: any("actors 2" in line for line in learner.lines[trained:]))
    assert [each.process.poll() for each in (router, learner, box)] == [None] * 3


def test_mistakes_with_certificates_are_reported_in_one_line(
    start: Start, tls: str, certificates: Path, tmp_path: Path
) -> None:
    """Further mistakes of addresses and certificates: test_bad_input.py, test_router.py, tests/transport."""
    strange = make_certificates(tmp_path / "strange")
    with closing(listen([tls], credentials=unchecked(certificates / "router", "router", ""))):
        for arguments, status, message in (
            (("actor", "--connect", tls, "--tls", strange / "actor-arm"), 1, "the two ends use different CAs"),
            (("learner", "cartpole", "--listen", "tcp/0.0.0.0:1"), 2, "is unencrypted and open to every host"),
            (("learner", "cartpole", "--listen", tls, "--tls", certificates / "actor-arm"), 2, "learner is required"),
        ):
            failed = start(*arguments)
            assert failed.wait() == status, failed.output
            failed.expect(message)
            assert "Traceback" not in failed.output


def test_users_of_one_router_are_kept_apart(start: Start, tls: str, tmp_path: Path) -> None:
    words = ("learner alice bob", "actor arm --run alice", "operator ann --run alice", "operator ben --run bob")
    folder = make_certificates(tmp_path / "certs", *words)
    start("router", "--listen", tls, "--tls", folder / "router").expect("listening")
    to = ("--connect", tls, "--tls")
    refused = start("learner", "cartpole", "--run-dir", "bob", *to, folder / "learner-alice")
    assert refused.wait() == 2
    refused.expect("is not for the run 'bob', only for 'alice'")
    learner = start("learner", "cartpole", "--run-dir", "alice", *ENDLESS, *SLOW, *to, folder / "learner-alice")
    start("actor", *to, folder / "actor-arm", *PLAYING_SLOW).expect("joined run 'alice'")
    learner.expect("actors 1")
    until(lambda: here("status", "--quiet", *to, folder / "operator-ann").status == 0)
    assert here("status", *to, folder / "operator-ben").status == 1
    assert here("stop", "alice", *to, folder / "operator-ben").status == 2
    assert learner.process.poll() is None
    assert here("stop", "alice", *to, folder / "operator-ann").status == 0
    assert learner.wait() == 0, learner.output
