"""Attack: clients of a gateway that break its protocol in every way, and thousands of idle connections.

    python -m benchmarks.attack hostile_clients

An honest client must be answered all the while, the gateway's memory must stay small, and the learner must train on the
honest client's rollouts.
"""

import contextlib
import json
import logging
import os
import random
import socket
import sys
import threading
import time
from pathlib import Path

from websockets.exceptions import WebSocketException
from websockets.sync.client import connect

from benchmarks.attack.verdict import Verdict
from benchmarks.chaos.scene import ENDLESS, scene

HELLO = {
    "type": "hello",
    "version": 1,
    "observations": {"observation": {"kind": "array", "shape": [4], "dtype": "float32"}},
    "actions": {"action": {"kind": "discrete", "counts": [2]}},
}
_SECONDS = 12.0
_IDLE_CONNECTIONS = 500
_MOST_SECONDS, _MOST_MEGABYTES = 5.0, 64.0  # for the honest client's slowest step, and of growth
_HUGE = {"observation": {"kind": "array", "shape": [4096, 4096], "dtype": "float32"}}


def _messages() -> list[str | bytes]:
    """Return messages that no honest client sends."""
    act = {"type": "act", "observation": [0.0] * 4}
    return [
        "{", "[" * 200_000, "\x00" * 1000, b"\xc1" * 1000, b"\xdd\xff\xff\xff\xff", "null", '{"type":"act"}',
        json.dumps({**HELLO, "name": "x" * 200_000}),
        json.dumps({**HELLO, "name": "a", "observations": _HUGE}),
        json.dumps({**HELLO, "name": "b", "observations": {f"c{i}": _HUGE["observation"] for i in range(1000)}}),
        json.dumps({**HELLO, "name": "\x1b[2J<script>alert(1)</script>"}),
        json.dumps({**act, "observation": [1e999, 0, 0, 0]}),
        json.dumps({**act, "observation": [[0.0]] * 4}),
        json.dumps({**act, "reward": 10**400}),
        json.dumps({"type": "end_episode", "terminated": True, "reward": -1e308}),
        " " * 300_000,
    ]  # fmt: skip


def hostile_clients() -> Verdict:
    """Attack a gateway for some seconds, and return whether the honest client noticed."""
    logging.getLogger("websockets").setLevel(logging.CRITICAL)  # of the attackers, whose connections are cut
    with scene() as here:
        here.start("learner", "cartpole", "--listen", here.address, "--run-dir", "run", *ENDLESS)
        gateway = here.start("gateway", "--connect", here.address, "--listen", "127.0.0.1:0", "--log-level", "info")
        port = int(gateway.expect(r"ws://127\.0\.0\.1:(\d+)/actor").group(1))
        gateway.expect("follows run")
        until = time.monotonic() + 5.0 + _SECONDS
        steps: list[float] = []
        honest = threading.Thread(target=play, args=(port, until, steps))
        honest.start()
        here.wait_for_training("honest")
        before = megabytes(gateway.process.pid)
        attackers = [threading.Thread(target=_attack, args=(port, until, seed)) for seed in range(4)]
        idle = []
        for thread in attackers:
            thread.start()
        for _ in range(_IDLE_CONNECTIONS):
            with contextlib.suppress(OSError):
                idle.append(socket.create_connection(("127.0.0.1", port), 5.0))
        for thread in (*attackers, honest):
            thread.join()
        grown = megabytes(gateway.process.pid) - before
        for connection in idle:
            connection.close()
        escaped = all(line.isprintable() for line in gateway.lines)
        alive = gateway.process.poll() is None
    slowest = max(steps, default=float("inf"))
    return Verdict(
        alive and escaped and slowest < _MOST_SECONDS and grown < _MOST_MEGABYTES,
        f"the honest client took {len(steps):,} steps, the slowest {slowest:.2f} s; the gateway grew by {grown:.0f} "
        f"MiB and {'lives' if alive else 'died'}; its log {'is' if escaped else 'IS NOT'} printable",
    )


def play(port: int, until: float, steps: list[float]) -> None:
    """Be an honest client until a monotonic time; add the seconds of each step."""
    with connect(f"ws://127.0.0.1:{port}/actor") as client:
        client.send(json.dumps({**HELLO, "name": "honest"}))
        client.recv(timeout=60)
        while time.monotonic() < until:
            sent = time.monotonic()
            client.send(json.dumps({"type": "act", "observation": [random.random() for _ in range(4)]}))
            client.recv(timeout=60)
            steps.append(time.monotonic() - sent)
            time.sleep(0.01)


def _attack(port: int, until: float, seed: int) -> None:
    chosen = random.Random(seed)
    while time.monotonic() < until:
        with contextlib.suppress(WebSocketException, OSError, EOFError, TimeoutError):
            _attack_once(port, f"hostile-{os.getpid()}-{seed}", chosen)


def _attack_once(port: int, name: str, chosen: random.Random) -> None:
    with connect(f"ws://127.0.0.1:{port}/actor", open_timeout=5, close_timeout=1) as client:
        if chosen.random() < 0.7:
            client.send(json.dumps({**HELLO, "name": name}))
            client.recv(timeout=5)
        for _ in range(chosen.randrange(20)):
            client.send(chosen.choice(_messages()))
        if chosen.random() < 0.5:
            for _ in range(3):
                client.recv(timeout=0.2)


def megabytes(process: int) -> float:
    """Return the memory of a process."""
    status = Path(f"/proc/{process}/status").read_text()
    return int(status.partition("VmRSS:")[2].split()[0]) / 1024


if __name__ == "__main__":
    verdict = hostile_clients()
    print(verdict)
    sys.exit(0 if verdict.held else 1)
