"""Attack: 1,100 TCP connections that say nothing, and are opened again when they are closed.

    python -m benchmarks.attack.silent_connections

The learner starts with a limit of 1,024 file descriptors, as most systems have it. It must save checkpoints and let
actors join while the attack lasts. Over TLS, Zenoh pauses for 0.1 s after each failed handshake: there, joins may be
late (docs/security.md).
"""

import contextlib
import resource
import socket
import sys
import threading
import time

from benchmarks.attack.verdict import Verdict
from benchmarks.chaos.scene import ENDLESS, Scene, scene

_CONNECTIONS, _SECONDS = 1100, 12.0
_USUAL_LIMIT = 1024
_MOST_JOIN_SECONDS = 30.0  # with the start of the actor's process, on a busy machine


def silent_connections() -> Verdict:
    """Open the connections, and return whether checkpoints were saved and actors joined meanwhile."""
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    with scene() as here:
        resource.setrlimit(resource.RLIMIT_NOFILE, (_USUAL_LIMIT, hard))
        try:  # the learner inherits the limit
            often = ("--set", "service.checkpoint_seconds=0.5")
            here.start("learner", "cartpole", "--listen", here.address, "--run-dir", "run", *often, *ENDLESS)
        finally:
            resource.setrlimit(resource.RLIMIT_NOFILE, (max(soft, 2 * _CONNECTIONS), hard))
        here.start("actor", "--connect", here.address, "--name", "early")
        here.wait_for_training("early")
        with _Silence(here.address) as silence:
            joins = _join_repeatedly(here)
            newest = _newest_checkpoint(here)
            here.wait("a checkpoint under the attack", lambda: _newest_checkpoint(here) > newest)
            here.wait_for_training("early")
        resource.setrlimit(resource.RLIMIT_NOFILE, (soft, hard))
    return Verdict(
        max(joins) <= _MOST_JOIN_SECONDS,
        f"{silence.opened:,} silent connections, {_CONNECTIONS:,} at once, in {_SECONDS:g} s: {len(joins)} actors "
        f"started and trained within {max(joins):.1f} s each; checkpoints and training went on",
    )


def _join_repeatedly(here: Scene) -> list[float]:
    """Start actors one after another while the attack lasts; return how long each took to contribute."""
    taken, until = [], time.monotonic() + _SECONDS
    while time.monotonic() < until:
        name, began = f"late-{len(taken)}", time.monotonic()
        running = here.start("actor", "--connect", here.address, "--name", name)
        here.wait_for_training(name)
        taken.append(time.monotonic() - began)
        running.end()
    return taken


def _newest_checkpoint(here: Scene) -> float:
    return max((entry.stat().st_mtime for entry in (here.folder / "run" / "checkpoints").iterdir()), default=0.0)


class _Silence:
    """Connections that send nothing, from construction as a context to its end."""

    def __init__(self, address: str) -> None:
        host, _, port = address.partition("/")[2].rpartition(":")
        self._target = host, int(port)
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._hold)
        self.opened = 0

    def __enter__(self) -> "_Silence":
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._stop.set()
        self._thread.join()

    def _hold(self) -> None:
        held: list[socket.socket] = []
        while not self._stop.wait(0.2):
            held = [link for link in held if self._is_open(link)]
            while len(held) < _CONNECTIONS and not self._stop.is_set():
                with contextlib.suppress(OSError):
                    held.append(socket.create_connection(self._target, timeout=5.0))
                    held[-1].setblocking(False)
                    self.opened += 1
        for link in held:
            link.close()

    @staticmethod
    def _is_open(link: socket.socket) -> bool:
        try:
            alive = link.recv(1) != b""
        except BlockingIOError:
            return True
        except OSError:
            alive = False
        if not alive:
            link.close()
        return alive


if __name__ == "__main__":
    verdict = silent_connections()
    print(verdict)
    sys.exit(0 if verdict.held else 1)
