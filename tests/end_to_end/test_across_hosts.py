"""Learner, router and actors on hosts with addresses of their own: real processes, a real network, real cuts."""

import json
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from hosts import Host, Network, NoHostsError
from processes import Running, until

from daedalus.cli.commands.certs import certs

TESTS = Path(__file__).parent.parent
PORT = 7447
ENDLESS = ("--set", "training.stop_when_solved=false", "--env-steps", 10**9)


@pytest.fixture
def network(tmp_path: Path) -> Iterator[Network]:
    try:
        made = Network(tmp_path)
    except NoHostsError as error:
        pytest.skip(f"no hosts can be made here: {error}")
    yield made
    made.close()


class Watched:
    """A learner that never ends by itself, as its status tells of it on its own host."""

    def __init__(self, host: Host, *more: object, ask: str) -> None:
        self.process = host.start("learner", "cartpole", *more, "--insecure", "--run-dir", "run", *ENDLESS)
        self._status = host.run(sys.executable, TESTS / "status_lines.py", ask)

    def status(self) -> dict:
        """The newest; empty while it does not answer."""
        line = self._status.lines[-1] if self._status.lines else ""
        return json.loads(line) if line else {}

    def actor(self, name: str) -> dict:
        """What it tells of one actor; empty if it does not know it."""
        return next((each for each in self.status().get("actors", ()) if each["actor"] == name), {})

    def trains_on(self, *names: str) -> None:
        """Waits until more of each was trained on."""
        until(lambda: all(self.actor(name) for name in names))
        before = {name: self.actor(name).get("env_steps", 0) for name in names}
        until(lambda: all(self.actor(name).get("env_steps", 0) > before[name] for name in names))


def play(host: Host, address: str, *more: object) -> Running:
    """An actor, named after its host."""
    return host.start("actor", "--connect", address, "--name", host.name, "--envs", 16, *more)


def address_of(host: Host, protocol: str = "tcp") -> str:
    return f"{protocol}/{host.address}:{PORT}"


def test_hosts_reach_each_other_and_nobody_else_and_leave_nothing_behind(tmp_path: Path, network: Network) -> None:
    other = Network(tmp_path)

    def spaces() -> int:
        listed = subprocess.run(["ip", "netns", "list"], capture_output=True, text=True, check=True)
        return listed.stdout.count(other.mark)

    try:
        host, neighbour = other.host("one"), other.host("two")
        assert host.reaches(neighbour.address)
        assert not host.reaches("192.0.2.1")
        sleeper = host.run("sleep", 1000)
        assert spaces() == 3
    finally:
        other.close()
    assert spaces() == 0
    assert sleeper.process.poll() is not None


def test_three_hosts_solve_a_run_over_tls_with_a_certificate_for_its_address(tmp_path: Path, network: Network) -> None:
    central = network.host("learner")
    players = [network.host(name) for name in ("arm", "box", "car")]
    folder = tmp_path / "certs"
    assert certs(["init", str(folder), "--host", central.address]) == 0
    assert certs(["issue", "actor", *(host.name for host in players), "--directory", str(folder)]) == 0
    address = address_of(central, "tls")
    actors = [host.start("actor", "--connect", address, "--tls", folder / f"actor-{host.name}") for host in players]
    for actor in actors:
        actor.expect("nothing answers .* waiting for it")  # all are there from the run's beginning
    everywhere = ("--listen", f"tls/0.0.0.0:{PORT}", "--tls", folder / "learner")
    learner = central.start("learner", "cartpole", *everywhere, "--run-dir", "run")
    for host, actor in zip(players, actors, strict=True):
        actor.expect(rf"joined run 'run' as '{host.name}\.\d+'")
    assert learner.wait() == 0, learner.output
    for actor in actors:
        assert actor.wait() == 0, actor.output
    assert json.loads((tmp_path / "run" / "summary.json").read_text())["solved"]


def test_actors_whose_address_is_cut_are_missed_and_come_back(network: Network) -> None:
    central, steady, unplugged, deaf = (network.host(name) for name in ("learner", "steady", "unplugged", "lost"))
    learner = Watched(central, "--listen", address_of(central), ask=address_of(central))
    actors = [play(host, address_of(central)) for host in (steady, unplugged, deaf)]
    learner.trains_on("steady", "unplugged", "lost")
    unplugged.unplug()
    deaf.lose(central)
    until(lambda: learner.actor("unplugged").get("alive") is False and learner.actor("lost").get("alive") is False)
    learner.trains_on("steady")
    until(lambda: learner.actor("steady").get("alive"))
    unplugged.plug_in()
    deaf.find(central)
    learner.trains_on("steady", "unplugged", "lost")
    until(lambda: [each["lives"] for each in learner.status().get("actors", ())] == [1, 1, 1])
    assert [actor.process.poll() for actor in actors] == [None] * 3


def test_all_find_each_other_again_when_the_host_of_their_router_was_cut_off(network: Network) -> None:
    middle, central = network.host("router"), network.host("learner")
    players = [network.host(name) for name in ("arm", "box", "car")]
    router = middle.start("router", "--listen", address_of(middle), "--insecure")
    learner = Watched(central, "--connect", address_of(middle), ask=address_of(middle))
    actors = [play(host, address_of(middle)) for host in players]
    learner.trains_on("arm", "box", "car")
    middle.unplug()
    until(lambda: not learner.status())
    middle.plug_in()
    learner.trains_on("arm", "box", "car")
    until(lambda: [each["lives"] for each in learner.status().get("actors", ())] == [1, 1, 1])
    assert [each.process.poll() for each in (router, learner.process, *actors)] == [None] * 5


@pytest.mark.skipif(shutil.which("iptables") is None, reason="there is no iptables here")
def test_actors_that_nobody_can_reach_or_whose_link_is_thin_are_trained_on(network: Network) -> None:
    central, steady, thin = (network.host(name) for name in ("learner", "steady", "thin"))
    try:
        hidden = network.host_behind_nat("robot")
        thin.limit("1mbit")
    except NoHostsError as error:
        pytest.skip(f"no address can be translated, or no rate limited here: {error}")
    assert hidden.reaches(central.address)
    assert not central.reaches(hidden.address)
    # The other actors' updates, hundreds a second on a fast machine, must not outrun the thin link.
    patient = ("--set", "training.max_policy_lag=10000")
    learner = Watched(central, "--listen", address_of(central), *patient, ask=address_of(central))
    for host in (steady, hidden, thin):
        play(host, address_of(central))
    learner.trains_on("robot", "steady", "thin")
    learner.trains_on("thin")
    assert all(each["alive"] for each in learner.status()["actors"])
