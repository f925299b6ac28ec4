"""Attack: a stranger on another host opens and closes TLS connections, and holds silent ones.

    python -m benchmarks.attack.tls_floods [--open]

Hosts are network namespaces, which needs root and iproute2, and the firewall is deploy/nftables/daedalus.nft; with
--open there is none. The learner has 1,024 file descriptors. An actor of a third host must join and be trained on soon
after 600 connections were opened and closed, and checkpoints must be saved while 1,100 silent ones are held.
"""

import argparse
import contextlib
import io
import os
import shutil
import sys
import tempfile
import time
from pathlib import Path

from hosts import Network, NoHostsError
from processes import DAEDALUS, Running

from benchmarks.attack.verdict import Verdict
from benchmarks.chaos.scene import ENDLESS
from daedalus.cli.commands.certs import certs

_FLOOD, _SILENT = 600, 1100
_DESCRIPTORS = 1024  # as most systems have it
_MOST_JOIN_SECONDS = 25.0  # with the start of the actor's process, on a busy machine
_LIMIT = 120.0  # seconds for each step
_FIREWALL = Path(__file__).parents[2] / "deploy" / "nftables" / "daedalus.nft"
_FLOODER = """
import socket, sys, time
host, number, silent = sys.argv[1], int(sys.argv[2]), sys.argv[3] == "silent"
held = []
while True:
    links = []
    for _ in range(number - len(held)):
        link = socket.socket()
        link.setblocking(False)
        link.connect_ex((host, 7447))
        links.append(link)
    print("opened", len(links), flush=True)
    if not silent:
        time.sleep(1.0)
        break
    held += links
    time.sleep(1.0)
"""


class _Hosts:
    """Three hosts with a learner, the stranger and actors."""

    def __init__(self, network: Network, folder: Path, firewall: bool) -> None:
        self._folder = folder
        self._learner, self._stranger, self._actors = (network.host(name) for name in ("box", "stranger", "arm"))
        self._joined = 0
        certificates = folder / "certs"
        init = ["init", str(certificates), "--host", self._learner.address]
        for words in (init, ["issue", "actor", "arm", "--directory", str(certificates)]):
            with contextlib.redirect_stdout(io.StringIO()):
                assert certs(words) == 0
        if firewall:
            network.command("box", "nft", "-f", str(_FIREWALL))
        often = ("--set", "service.checkpoint_seconds=0.5")
        words = ("learner", "cartpole", "--listen", "tls/0.0.0.0:7447", "--tls", certificates / "learner")
        limited = ("prlimit", f"--nofile={_DESCRIPTORS}:{_DESCRIPTORS}", *DAEDALUS)  # it may not raise the limit
        self.learner = self._learner.run(*limited, *words, "--run-dir", "run", *often, *ENDLESS)
        self.learner.expect("actors join with")

    def stranger(self, number: int, kind: str) -> Running:
        """Start connections of the stranger."""
        return self._stranger.run(sys.executable, "-c", _FLOODER, self._learner.address, number, kind)

    def join(self) -> float:
        """Start an actor, wait until it takes part, and return the seconds."""
        began, self._joined = time.monotonic(), self._joined + 1
        to = ("--connect", f"tls/{self._learner.address}:7447", "--tls", self._folder / "certs" / "actor-arm")
        with contextlib.suppress(AssertionError):  # not within two minutes
            self._actors.start("actor", *to, "--name", f"arm.{self._joined}").expect("joined run")
        return time.monotonic() - began

    def checkpoint(self) -> float:
        """Wait for a new checkpoint and return the seconds, or the limit if there is none."""
        began, folder = time.monotonic(), self._folder / "run" / "checkpoints"
        newest = _newest(folder)
        while _newest(folder) <= newest and time.monotonic() < began + _LIMIT:
            time.sleep(0.05)
        return time.monotonic() - began


def _newest(folder: Path) -> str:
    return (
        max((entry.name for entry in folder.iterdir() if entry.name.isdecimal()), default="") if folder.exists() else ""
    )


def tls_floods(*, firewall: bool = True) -> Verdict:
    """Make both floods; return whether actors could join and checkpoints were saved."""
    missing = [name for name in ("nft", "prlimit") if shutil.which(name) is None]
    if missing or os.geteuid() != 0:
        return Verdict(True, f"not tried: needs root, and {', '.join(missing) or 'nft'} (package nftables)")
    with tempfile.TemporaryDirectory() as name:
        try:
            network = Network(Path(name))
        except NoHostsError as error:
            return Verdict(True, f"not tried: {error}")
        try:
            return _attack(_Hosts(network, Path(name), firewall))
        finally:
            network.close()


def _attack(hosts: _Hosts) -> Verdict:
    quiet = hosts.join()
    hosts.checkpoint()
    hosts.stranger(_FLOOD, "closed").wait()
    after_flood = hosts.join()
    silent = hosts.stranger(_SILENT, "silent")
    silent.expect("opened")
    time.sleep(2.0)
    saved, beside_silent = hosts.checkpoint(), hosts.join()
    alive = hosts.learner.process.poll() is None and "Too many open files" not in hosts.learner.output
    held = alive and max(after_flood, beside_silent) <= _MOST_JOIN_SECONDS and saved <= _MOST_JOIN_SECONDS
    return Verdict(
        held,
        f"over TLS an actor joined within {quiet:.1f} s before, {after_flood:.1f} s after {_FLOOD} connections that "
        f"were opened and closed, and {beside_silent:.1f} s beside {_SILENT:,} silent ones; "
        f"a checkpoint took {saved:.1f} s",
    )


if __name__ == "__main__":
    options = argparse.ArgumentParser(prog="python -m benchmarks.attack.tls_floods")
    options.add_argument("--open", action="store_true", help="without the firewall")
    verdict = tls_floods(firewall=not options.parse_args().open)
    print(verdict)
    sys.exit(0 if verdict.held else 1)
