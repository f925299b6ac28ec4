"""Test of learner, router and actors on several hosts (network namespaces), with failures of the network."""

import json
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from certificates import change_certificates
from hosts import Host, Network, NoHostsError, network_in
from processes import ENDLESS, PLAYING_SLOW, SLOW, Running, until

from daedalus.cli.commands.certs import certs

TESTS = Path(__file__).parent.parent
PORT = 7447
LOST_CONNECTIONS = 48  # at the same time; if closing one took 10 s, the learner would receive nothing for minutes


@pytest.fixture
def network(tmp_path: Path) -> Iterator[Network]:
    shutil.copy(TESTS / "slow_environment.py", tmp_path)
    with network_in(tmp_path) as made:
        yield made


class EndlessLearner:
    """Learner with an endless run, and its status as seen from its own host."""

    def __init__(self, host: Host, *more: object, ask: str) -> None:
        self.process = host.start("learner", "cartpole", *more, "--insecure", "--run-dir", "run", *ENDLESS, *SLOW)
        self._status = host.run(sys.executable, TESTS / "status_lines.py", ask)

    def status(self) -> dict:
        """Return the newest status, or an empty dict while the learner does not answer."""
        line = self._status.lines[-1] if self._status.lines else ""
        return json.loads(line) if line else {}

    def actor(self, name: str) -> dict:
        """Return the status of one actor, or an empty dict if the learner does not know it."""
        return next((each for each in self.status().get("actors", ()) if each["actor"] == name), {})

    def wait_for_training_on(self, *names: str) -> None:
        """Wait until the learner has trained on new rollouts of each actor."""
        until(lambda: all(self.actor(name) for name in names))
        before = {name: self.actor(name).get("env_steps", 0) for name in names}
        until(lambda: all(self.actor(name).get("env_steps", 0) > before[name] for name in names))


def play(host: Host, address: str, *more: object) -> Running:
    """Start an actor that is named after its host."""
    return host.start("actor", "--connect", address, "--name", host.name, *PLAYING_SLOW, *more)


def address_of(host: Host, protocol: str = "tcp") -> str:
    return f"{protocol}/{host.address}:{PORT}"


def test_hosts_reach_only_each_other_and_are_removed_at_the_end(tmp_path: Path, network: Network) -> None:
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


def test_actors_on_other_hosts_train_over_tls_until_the_end_of_the_run(tmp_path: Path, network: Network) -> None:
    central = network.host("learner")
    players = [network.host(name) for name in ("arm", "box")]
    folder = tmp_path / "certs"
    assert certs(["init", str(folder), "--host", central.address]) == 0
    change_certificates(folder, "issue actor arm box")
    address = address_of(central, "tls")
    words = ("actor", "--connect", address, *PLAYING_SLOW, "--tls")
    actors = [host.start(*words, folder / f"actor-{host.name}") for host in players]
    for actor in actors:
        actor.expect("nothing answers .* waiting for it")  # all actors take part from the start of the run
    everywhere = ("--listen", f"tls/0.0.0.0:{PORT}", "--tls", folder / "learner")
    budget = (*ENDLESS[:2], *SLOW, "--env-steps", 1_500)
    learner = central.start("learner", "cartpole", *everywhere, "--run-dir", "run", *budget)
    for host, actor in zip(players, actors, strict=True):
        actor.expect(rf"joined run 'run' as '{host.name}\.[\w-]+-\d+'")
    assert learner.wait() in (0, 3), learner.output
    for actor in actors:
        assert actor.wait() == 0, actor.output
    assert json.loads((tmp_path / "run" / "summary.json").read_text())["env_steps"] >= 1_500


def test_actors_are_noticed_as_gone_when_their_link_fails_and_return_when_it_works(network: Network) -> None:
    central, steady, unplugged, deaf = (network.host(name) for name in ("learner", "steady", "unplugged", "lost"))
    learner = EndlessLearner(central, "--listen", address_of(central), ask=address_of(central))
    actors = [play(host, address_of(central)) for host in (steady, unplugged, deaf)]
    learner.wait_for_training_on("steady", "unplugged", "lost")
    others = unplugged.run(sys.executable, TESTS / "idle_sessions.py", address_of(central), LOST_CONNECTIONS)
    others.expect("connected")
    unplugged.unplug()
    deaf.lose(central)
    until(lambda: learner.actor("unplugged").get("alive") is False and learner.actor("lost").get("alive") is False)
    learner.wait_for_training_on("steady")
    until(lambda: learner.actor("steady").get("alive"))
    unplugged.plug_in()
    deaf.find(central)
    learner.wait_for_training_on("steady", "unplugged", "lost")
    until(lambda: [each["lives"] for each in learner.status().get("actors", ())] == [1, 1, 1])
    assert [actor.process.poll() for actor in actors] == [None] * 3


def test_a_firewall_that_drops_packets_is_named_by_every_command(network: Network) -> None:
    central, player = network.host("central"), network.host("player")
    central.lose(player)
    address = address_of(central)
    to, silent = ("--connect", address), rf"no answer from {address}: check the address, .* no firewall drops packets"
    once = [player.start(*words, *to) for words in (("actor", "--timeout", 0.5), ("status",), ("drain", "arm"))]
    lasting = [
        player.start(*words, *to)
        for words in (
            ("learner", "cartpole"),
            ("actor", "--evaluator"),
            ("exporter", "--listen", "127.0.0.1:0"),
            ("gateway", "--listen", "127.0.0.1:0"),
            ("router", "--insecure", "--listen", address_of(player)),
        )
    ]
    for command in (*once, *lasting):
        command.expect(silent)
    assert [command.wait() for command in once] == [1, 1, 1]
    assert [command.process.poll() for command in lasting] == [None] * 5


def test_learner_and_actors_reconnect_after_the_host_of_the_router_was_unreachable(network: Network) -> None:
    middle, central = network.host("router"), network.host("learner")
    players = [network.host(name) for name in ("arm", "box", "car")]
    router = middle.start("router", "--listen", address_of(middle), "--insecure")
    learner = EndlessLearner(central, "--connect", address_of(middle), ask=address_of(middle))
    actors = [play(host, address_of(middle)) for host in players]
    learner.wait_for_training_on("arm", "box", "car")
    middle.unplug()
    until(lambda: not learner.status())
    middle.plug_in()
    learner.wait_for_training_on("arm", "box", "car")
    until(lambda: [each["lives"] for each in learner.status().get("actors", ())] == [1, 1, 1])
    assert [each.process.poll() for each in (router, learner.process, *actors)] == [None] * 5


@pytest.mark.skipif(shutil.which("iptables") is None, reason="iptables is not installed")
def test_actors_behind_nat_or_on_a_slow_link_are_trained_on(network: Network) -> None:
    central, thin = network.host("learner"), network.host("thin")
    try:
        hidden = network.host_behind_nat("robot")
        thin.limit("1mbit")
    except NoHostsError as error:
        pytest.skip(f"this machine cannot do NAT or limit a rate: {error}")
    assert hidden.reaches(central.address)
    assert not central.reaches(hidden.address)
    # The rollouts of the other actor cause more updates than the slow link can follow.
    patient = ("--set", "training.max_policy_lag=10000")
    learner = EndlessLearner(central, "--listen", address_of(central), *patient, ask=address_of(central))
    for host in (hidden, thin):
        play(host, address_of(central))
    learner.wait_for_training_on("robot", "thin")
    learner.wait_for_training_on("thin")
    assert all(each["alive"] for each in learner.status()["actors"])
