"""Test of learner, actors and status over TLS."""

from collections.abc import Callable
from pathlib import Path

import pytest
from certificates import make_certificates
from processes import Running, until

from daedalus.cli.commands.certs import certs

Start = Callable[..., Running]


@pytest.fixture
def certificates(tmp_path: Path) -> Path:
    return make_certificates(tmp_path / "certs")


@pytest.fixture
def tls(address: str) -> str:
    return address.replace("tcp/", "tls/")


def test_authorised_actors_solve_cartpole_over_tls(start: Start, tls: str, certificates: Path) -> None:
    learner = start("learner", "cartpole", "--listen", tls, "--tls", certificates / "learner", "--run-dir", "run")
    arm = start("actor", "--connect", tls, "--tls", certificates / "actor-arm")
    arm.expect(r"joined run 'run' as 'arm\.\d+'")
    start("actor", "--connect", tls, "--tls", certificates / "actor-box", "--name", "box").expect("joined run")
    assert learner.wait() == 0, learner.output
    assert arm.wait() == 0, arm.output


def test_authorised_actors_of_other_machines_join_train_over_tls(start: Start, tls: str, certificates: Path) -> None:
    endless = ("--set", "training.stop_when_solved=false", "--env-steps", 10**9)
    training = ("--listen", tls, "--tls", certificates / "learner", "--actors", 1, *endless)
    train = start("train", "cartpole", *training)
    train.expect("return .* actors 1")
    start("actor", "--connect", tls, "--tls", certificates / "actor-arm").expect("joined run")
    train.expect("actors 2")
    asking = ("status", "--connect", tls, "--quiet", "--tls")
    assert start(*asking, certificates / "actor-arm").wait() == 2
    until(lambda: start(*asking, certificates / "operator").wait() == 0)


def test_an_unauthorised_actor_gets_a_hint_about_the_list_of_names(start: Start, tls: str, certificates: Path) -> None:
    """Issue a valid certificate after the start of the learner."""
    start("learner", "cartpole", "--listen", tls, "--tls", certificates / "learner", "--run-dir", "run").expect(
        "actors join with"
    )
    assert certs(["issue", "actor", "late", "--directory", str(certificates)]) == 0
    late = start("actor", "--connect", tls, "--tls", certificates / "actor-late", "--timeout", 3)
    assert late.wait() == 1
    late.expect("no learner answered .* actor 'late' authorised by it .or by its router..* is read at start")


def test_mistakes_with_certificates_are_reported_in_one_line(
    start: Start, tls: str, certificates: Path, tmp_path: Path
) -> None:
    strange = make_certificates(tmp_path / "strange")
    learner = start("learner", "cartpole", "--listen", tls, "--tls", certificates / "learner", "--run-dir", "run")
    learner.expect("actors join with")
    to = ("actor", "--connect", tls)
    for arguments, status, message in (
        ((*to, "--tls", strange / "actor-arm"), 1, "the two ends use different CAs"),
        ((*to, "--tls", certificates / "learner"), 2, "holds the certificate of learner, but actor is required"),
        ((*to, "--tls", certificates / "actor-arm", "--name", "box"), 2, "is not for 'box': use --name arm or arm.ANY"),
        (to, 2, "needs certificates: --tls DIR"),
        (("actor", "--connect", tls.replace("tls", "tcp"), "--timeout", 0.1), 1, "requires --tls"),
        (
            ("actor", "--connect", "tls/nowhere.invalid:1", "--tls", certificates / "actor-arm", "--timeout", 0.1),
            1,
            "cannot be resolved to an address",
        ),
        (("learner", "cartpole", "--listen", "tcp/0.0.0.0:0"), 2, "is unencrypted and open to every host"),
        (("train", "cartpole", "--listen", "tcp/0.0.0.0:0"), 2, "is unencrypted and open to every host"),
        (("learner", "cartpole", "--listen", tls, "--tls", certificates / "actor-arm"), 2, "learner is required"),
    ):
        failed = start(*arguments)
        assert failed.wait() == status, failed.output
        failed.expect(message)
        assert "Traceback" not in failed.output
    assert learner.process.poll() is None
