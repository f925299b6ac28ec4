"""Network namespaces of this machine that act as hosts with their own addresses, connected by one switch.

The switch is in a namespace too, so that the network of the machine does not change. Needs Linux, root and iproute2.
"""

import secrets
import shutil
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from processes import Running, command_line

_SWITCH = "switch"


class NoHostsError(Exception):
    """Error if this machine cannot create network namespaces. The message gives the reason."""


class Host:
    """Network namespace with one address, which its processes see as a machine of their own."""

    def __init__(self, network: "Network", name: str, address: str) -> None:
        self._network, self.name, self.address = network, name, address

    def start(self, *arguments: object) -> Running:
        """Start `daedalus ARGUMENTS` on this host."""
        return self.run(*command_line(*arguments))

    def run(self, *command: object) -> Running:
        """Start a command on this host."""
        return self._network.run(self.name, *command)

    def unplug(self) -> None:
        """Disconnect the host from the switch. Its connections get no error."""
        self._network.command(_SWITCH, "ip", "link", "set", self.name, "down")

    def plug_in(self) -> None:
        """Connect the host to the switch again."""
        self._network.command(_SWITCH, "ip", "link", "set", self.name, "up")

    def lose(self, other: "Host") -> None:
        """Drop all packets that this host sends to another. Packets of the other host still arrive."""
        self._network.command(self.name, "ip", "route", "add", "blackhole", other.address)

    def find(self, other: "Host") -> None:
        """Send packets to the other host again."""
        self._network.command(self.name, "ip", "route", "del", "blackhole", other.address)

    def limit(self, rate: str) -> None:
        """Limit the link in both directions to a rate such as `1mbit`."""
        for place, device in ((self.name, "eth0"), (_SWITCH, self.name)):
            bucket = ("tbf", "rate", rate, "burst", "4kb", "latency", "400ms")
            self._network.command(place, "tc", "qdisc", "add", "dev", device, "root", *bucket)

    def reaches(self, address: str) -> bool:
        """Return whether this host has a route to an address."""
        words = self._network.words(self.name, "ip", "route", "get", address)
        return subprocess.run(words, capture_output=True, check=False).returncode == 0


class Network:
    """Switch and its hosts."""

    def __init__(self, directory: Path) -> None:
        """Create the switch. Processes run in `directory`. Raises NoHostsError."""
        self._directory = directory
        self.mark = f"daedalus-{secrets.token_hex(4)}"  # prefix of the names of its namespaces
        self._spaces: list[str] = []
        self._running: list[Running] = []
        self._hosts = 0
        if shutil.which("ip") is None or shutil.which("tc") is None:
            raise NoHostsError("ip and tc are not installed: install iproute2")
        try:
            self._space(_SWITCH)
            self.command(_SWITCH, "ip", "link", "add", "bridge", "type", "bridge")
            self.command(_SWITCH, "ip", "link", "set", "bridge", "up")
        except BaseException:
            self.close()
            raise

    def host(self, name: str) -> Host:
        """Add a host to the switch and return it."""
        self._space(name)
        self._cable(name, "eth0", _SWITCH, name)
        self.command(_SWITCH, "ip", "link", "set", name, "master", "bridge")
        self._hosts += 1
        address = f"10.77.0.{self._hosts}"
        self.command(name, "ip", "address", "add", f"{address}/24", "dev", "eth0")
        return Host(self, name, address)

    def host_behind_nat(self, name: str) -> Host:
        """Add a host that reaches the others through NAT, so that the others have no route to it."""
        gateway = self.host(f"{name}-nat")
        self._space(name)
        self._cable(name, "eth0", gateway.name, "inside")
        self.command(gateway.name, "ip", "address", "add", "192.168.77.1/24", "dev", "inside")
        self.command(name, "ip", "address", "add", "192.168.77.2/24", "dev", "eth0")
        self.command(name, "ip", "route", "add", "default", "via", "192.168.77.1")
        self.command(gateway.name, "sysctl", "-qw", "net.ipv4.ip_forward=1")
        masquerade = ("iptables", "-t", "nat", "-A", "POSTROUTING", "-o", "eth0", "-j", "MASQUERADE")
        self.command(gateway.name, *masquerade)
        return Host(self, name, "192.168.77.2")

    def run(self, space: str, *command: object) -> Running:
        """Start a command in a namespace."""
        self._running.append(Running(self.words(space, *command), self._directory))
        return self._running[-1]

    def words(self, space: str, *command: object) -> list[str]:
        """Return the command line that runs a command in a namespace, as the same process."""
        return ["ip", "netns", "exec", self._named(space), *map(str, command)]

    def command(self, space: str, *command: str) -> None:
        """Run a command in a namespace and wait for its end. Raises NoHostsError if it fails."""
        _run(*self.words(space, *command))

    def close(self) -> None:
        """End all processes and delete all namespaces."""
        for running in self._running:
            running.end()
        for name in self._spaces:
            subprocess.run(["ip", "netns", "delete", name], capture_output=True, check=False)

    def _space(self, name: str) -> None:
        _run("ip", "netns", "add", self._named(name))
        self._spaces.append(self._named(name))
        self.command(name, "ip", "link", "set", "lo", "up")

    def _cable(self, near: str, near_device: str, far: str, far_device: str) -> None:
        far_end = ("type", "veth", "peer", "name", far_device, "netns", self._named(far))
        self.command(near, "ip", "link", "add", near_device, *far_end)
        self.command(near, "ip", "link", "set", near_device, "up")
        self.command(far, "ip", "link", "set", far_device, "up")

    def _named(self, space: str) -> str:
        return f"{self.mark}-{space}"


def _run(*words: str) -> None:
    finished = subprocess.run(words, capture_output=True, text=True, check=False)
    if finished.returncode:
        raise NoHostsError(f"`{' '.join(words)}` failed: {finished.stderr.strip() or finished.stdout.strip()}")


@contextmanager
def network_in(directory: Path) -> Iterator[Network]:
    """Give a network whose processes run in a directory; skip the test where this machine cannot create one."""
    try:
        made = Network(directory)
    except NoHostsError as error:
        pytest.skip(f"this machine cannot create network namespaces: {error}")
    try:
        yield made
    finally:
        made.close()
