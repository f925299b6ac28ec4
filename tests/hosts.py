"""Several hosts on this machine: network namespaces with addresses of their own, joined by cables to one switch.

The switch has a namespace too, and nothing of the machine's own network is touched. Needs Linux, root and iproute2.
"""

import secrets
import shutil
import subprocess
import sys
from pathlib import Path

from processes import Running

DAEDALUS = [sys.executable, "-P", "-c", "from daedalus.cli.main import main; raise SystemExit(main())"]
_SWITCH = "switch"


class NoHostsError(Exception):
    """This machine makes no such hosts; the message says why."""


class Host:
    """A machine with one address, as far as the processes on it can tell."""

    def __init__(self, network: "Network", name: str, address: str) -> None:
        self._network, self.name, self.address = network, name, address

    def start(self, *arguments: object) -> Running:
        """Starts `daedalus ARGUMENTS` there."""
        return self.run(*DAEDALUS, *arguments)

    def run(self, *command: object) -> Running:
        """Starts any command there."""
        return self._network.run(self.name, *command)

    def unplug(self) -> None:
        """Pulls its cable: no byte comes or goes, and nobody is told."""
        self._network.command(_SWITCH, "ip", "link", "set", self.name, "down")

    def plug_in(self) -> None:
        """Puts the cable back."""
        self._network.command(_SWITCH, "ip", "link", "set", self.name, "up")

    def lose(self, other: "Host") -> None:
        """Drops all that it sends to another, whose own still arrives."""
        self._network.command(self.name, "ip", "route", "add", "blackhole", other.address)

    def find(self, other: "Host") -> None:
        """Sends to the other again."""
        self._network.command(self.name, "ip", "route", "del", "blackhole", other.address)

    def limit(self, rate: str) -> None:
        """Lets its cable carry no more than that each way: `1mbit`."""
        for place, device in ((self.name, "eth0"), (_SWITCH, self.name)):
            bucket = ("tbf", "rate", rate, "burst", "4kb", "latency", "400ms")
            self._network.command(place, "tc", "qdisc", "add", "dev", device, "root", *bucket)

    def reaches(self, address: str) -> bool:
        """Whether it has a way to an address at all."""
        words = self._network.words(self.name, "ip", "route", "get", address)
        return subprocess.run(words, capture_output=True, check=False).returncode == 0


class Network:
    """A switch, and the hosts on it."""

    def __init__(self, directory: Path) -> None:
        """Processes run in `directory`. Raises NoHostsError where this machine makes no hosts."""
        self._directory = directory
        self.mark = f"daedalus-{secrets.token_hex(4)}"  # the names of its namespaces begin with it
        self._spaces: list[str] = []
        self._running: list[Running] = []
        self._hosts = 0
        if shutil.which("ip") is None or shutil.which("tc") is None:
            raise NoHostsError("there are no ip and tc here: install iproute2")
        try:
            self._space(_SWITCH)
            self.command(_SWITCH, "ip", "link", "add", "bridge", "type", "bridge")
            self.command(_SWITCH, "ip", "link", "set", "bridge", "up")
        except BaseException:
            self.close()
            raise

    def host(self, name: str) -> Host:
        """Another host on the switch."""
        self._space(name)
        self._cable(name, "eth0", _SWITCH, name)
        self.command(_SWITCH, "ip", "link", "set", name, "master", "bridge")
        self._hosts += 1
        address = f"10.77.0.{self._hosts}"
        self.command(name, "ip", "address", "add", f"{address}/24", "dev", "eth0")
        return Host(self, name, address)

    def host_behind_nat(self, name: str) -> Host:
        """One that reaches all others by a gateway, which hides it: nobody has a way to it."""
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
        """Starts a command in a namespace."""
        self._running.append(Running(self.words(space, *command), self._directory))
        return self._running[-1]

    def words(self, space: str, *command: object) -> list[str]:
        """A command, as it is given for a namespace: the process that this starts becomes the command's own."""
        return ["ip", "netns", "exec", self._named(space), *map(str, command)]

    def command(self, space: str, *command: str) -> None:
        """Runs a command in a namespace to its end. Raises NoHostsError if it fails."""
        _run(*self.words(space, *command))

    def close(self) -> None:
        """Ends all processes and takes every namespace away, and with it what is in it."""
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
