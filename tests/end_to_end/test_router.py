"""Test of the router process."""

from collections.abc import Callable
from pathlib import Path

import pytest
from certificates import make_certificates
from processes import Running, free_address, until

from daedalus.cli.command_table import COMMANDS

Start = Callable[..., Running]


@pytest.fixture
def other_address() -> str:
    return free_address()


def test_a_router_prints_its_address_and_ends_on_sigterm(start: Start, address: str) -> None:
    router = start("router", "--listen", address)
    router.expect(f"listening on {address}")
    second = start("router", "--listen", address)
    assert second.wait() == 1
    second.expect(f"daedalus router: address {address} is already in use")
    router.process.terminate()
    assert router.wait() == 0
    assert len(router.lines) == 1


def test_a_run_works_over_two_routers_that_start_in_any_order(start: Start, address: str, other_address: str) -> None:
    start("router", "--listen", other_address, "--connect", address).expect("listening")
    learner = start("learner", "cartpole", "--connect", other_address, "--run-dir", "run", "--env-steps", 30000)
    start("actor", "--connect", address)
    start("router", "--listen", address)
    assert learner.wait() == 3, learner.output


def test_a_learner_that_waits_for_a_router_is_alive_and_leaves_no_directory(
    start: Start, address: str, tmp_path: Path
) -> None:
    learner = start("learner", "cartpole", "--connect", address, "--run-dir", "run")
    learner.expect("waiting for it")
    assert start("status", "--alive", "run").wait() == 0
    learner.process.terminate()
    assert learner.wait() == 0
    assert not (tmp_path / "run").exists()


def test_router_and_exporter_accept_only_certificates_of_their_ca(start: Start, address: str, tmp_path: Path) -> None:
    certificates = make_certificates(tmp_path / "certs")
    tls = address.replace("tcp/", "tls/")
    start("router", "--listen", tls, "--tls", certificates / "router").expect("listening")
    asked = ("exporter", "--connect", tls, "--listen", "127.0.0.1:0", "--tls")
    start(*asked, certificates / "operator").expect("http://")
    strange = start(*asked, make_certificates(tmp_path / "strange") / "operator")
    strange.expect("cannot be verified: .*different CAs")
    assert strange.process.poll() is None  # somebody else can correct it: the exporter tries again
    learner = start("learner", "cartpole", "--connect", tls, "--tls", certificates / "learner", "--run-dir", "run")
    start("actor", "--connect", tls, "--tls", certificates / "actor-arm")
    asking = ("status", "--connect", tls, "--quiet", "--tls", certificates / "operator")
    until(lambda: start(*asking).wait() == 0)
    assert learner.wait() == 0, learner.output


@pytest.mark.parametrize(
    ("command", "arguments", "message"),
    [
        ("router", ["--listen", "tcp/0.0.0.0:1"], "is unencrypted and open to every host"),
        ("router", ["--listen", "tls/127.0.0.1:1"], "needs certificates: --tls DIR"),
        ("router", ["--connect", "tls/127.0.0.1:1"], "needs certificates: --tls DIR"),
        ("exporter", ["--connect", "tls/127.0.0.1:1"], "needs certificates: --tls DIR"),
    ],
)
def test_an_insecure_address_is_bad_usage(
    capsys: pytest.CaptureFixture[str], command: str, arguments: list[str], message: str
) -> None:
    assert COMMANDS[command].run(arguments) == 2
    assert message in capsys.readouterr().err
