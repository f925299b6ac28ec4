"""Routers and the exporter, as processes."""

import urllib.request
from collections.abc import Callable
from datetime import timedelta
from pathlib import Path

import pytest
from certificates import make_certificates
from processes import ENDLESS, PLAYING_SLOW, SLOW, Running, free_address, here, until
from prometheus_client.parser import text_string_to_metric_families

from daedalus.cli.command_table import COMMANDS
from daedalus.launch.certificates import CertificateFolder, Identity

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


def test_a_learner_that_waits_for_a_router_is_alive_and_leaves_no_directory(
    start: Start, address: str, tmp_path: Path
) -> None:
    learner = start("learner", "cartpole", "--connect", address, "--run-dir", "run")
    learner.expect("waiting for it")
    assert here("status", "--alive", tmp_path / "run").status == 0
    learner.process.terminate()
    assert learner.wait() == 0
    assert not (tmp_path / "run").exists()


def test_router_and_exporter_accept_only_certificates_of_their_ca_and_say_when_they_expire(
    start: Start, address: str, tmp_path: Path
) -> None:
    certificates = make_certificates(tmp_path / "certs")
    CertificateFolder(certificates).issue([Identity("router")], timedelta(minutes=20))
    tls = address.replace("tcp/", "tls/")
    router = start("router", "--listen", tls, "--tls", certificates / "router")
    router.expect("the certificate in .*router expires in 19 minutes, on .*: renew it")
    router.expect(f"listening on {tls}; the certificate is for .*localhost, 127.0.0.1")
    asked = ("exporter", "--connect", tls, "--listen", "127.0.0.1:0", "--tls")
    where = start(*asked, certificates / "operator").expect(r"http://\S+")[0]

    def days_left() -> dict[str, float]:
        families = text_string_to_metric_families(urllib.request.urlopen(where).read().decode())
        samples = [sample for family in families for sample in family.samples]
        return {each.labels["role"]: each.value for each in samples if each.name == "daedalus_certificate_days_left"}

    until(lambda: 0.0 < days_left().get("router", 0.0) < 20 / 1440 and days_left()["exporter"] > 800)
    strange = start(*asked, make_certificates(tmp_path / "strange") / "operator")
    strange.expect("cannot be verified: .*different CAs")
    assert strange.process.poll() is None  # somebody else can correct it: the exporter tries again


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


def scrape(url: str) -> dict[tuple[str, str], float]:
    """Return the values by the names of sample and actor."""
    with urllib.request.urlopen(url, timeout=60) as answer:
        families = text_string_to_metric_families(answer.read().decode())
        return {(each.name, each.labels.get("actor", "")): each.value for family in families for each in family.samples}


def test_a_run_works_over_two_routers_and_the_exporter_serves_metrics_of_present_processes_only(
    start: Start, address: str, other_address: str
) -> None:
    """The routers start in any order; actors and exporter are at the one, the learner at the other."""
    exporter = start("exporter", "--connect", address, "--listen", "127.0.0.1:0")
    url = exporter.expect(r"http://\S+").group()
    assert scrape(url) == {("daedalus_up", ""): 0.0}
    second = start("router", "--listen", other_address, "--connect", address)
    second.expect(f"nothing answers at {address}: .*; trying again")
    learner = start("learner", "cartpole", "--connect", other_address, "--run-dir", "run", *ENDLESS, *SLOW)
    start("router", "--listen", address)
    second.expect(f"connected to {address}")
    actors = {name: start("actor", "--connect", address, "--name", name, *PLAYING_SLOW) for name in ("a", "b")}
    env_steps = "daedalus_actor_env_steps_total"
    until(lambda: all(scrape(url).get((env_steps, name), 0.0) > 0.0 for name in actors))
    samples = scrape(url)
    assert (samples["daedalus_up", ""], samples["daedalus_healthy", ""]) == (1.0, 1.0)
    assert samples["daedalus_env_steps_total", ""] > 0.0
    actors["a"].process.kill()
    until(lambda: (env_steps, "a") not in scrape(url))
    assert {actor for _, actor in scrape(url) if actor} == {"b"}
    learner.process.kill()
    until(lambda: scrape(url) == {("daedalus_up", ""): 0.0})
    exporter.process.terminate()
    assert exporter.wait() == 0
