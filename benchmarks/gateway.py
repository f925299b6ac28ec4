"""Measure a gateway: clients at a fixed rate, the latency of their actions, and the CPU time that a step costs.

    python -m benchmarks.gateway --clients 200 --rate 20 --seconds 20

A learner of the preset cartpole trains on the clients' rollouts meanwhile. The gateway has one core of its own; the
clients and the learner, at a low priority, share another. The clients' steps are spread evenly over a period, as those
of a fleet are; all began together, so that their rollouts are full together. Their observations are random: nothing is
learned. `sent late` is how long after its time the load generator sent an observation: where it comes near the latency,
the machine was busy, and the figures say nothing. For comparison, a process with `daedalus.actor.Client`s plays at the
same rate.
"""

import argparse
import json
import os
import random
import select
import socket
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

from benchmarks.running import COMMAND, cpu_seconds, machine, table

_HELLO = {
    "type": "hello",
    "version": 1,
    "observations": {"observation": {"kind": "array", "shape": [4], "dtype": "float32"}},
    "actions": {"action": {"kind": "discrete", "counts": [2]}},
}
_EPISODE_STEPS = 100
_WARM_SECONDS = 8.0
_HANDSHAKE = (
    "GET /actor HTTP/1.1\r\nHost: 127.0.0.1:{port}\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n"
    "Sec-WebSocket-Key: AAAAAAAAAAAAAAAAAAAAAA==\r\nSec-WebSocket-Version: 13\r\n\r\n"
)


def frame(text: str) -> bytes:
    """Return a masked text frame; the mask is zero, which costs nothing to apply."""
    data = text.encode()
    size = bytes([0x80 | len(data)]) if len(data) < 126 else bytes([0xFE]) + len(data).to_bytes(2, "big")
    return b"\x81" + size + bytes(4) + data


_FIRST_ACT = frame('{"type":"act","observation":[0.01,0.02,-0.03,0.04]}')
_END = frame('{"type":"end_episode","terminated":true,"observation":[0.01,0.02,-0.03,0.04],"reward":1.0}')
_ACTS = [
    frame(json.dumps({"type": "act", "observation": [random.uniform(-1, 1) for _ in range(4)], "reward": 1.0}))
    for _ in range(10)
]


class Fleet:
    """Clients whose steps are spread evenly over a period, on one thread that costs little of a core.

    asyncio would cost the load generator more than the gateway, and its delays would count as the gateway's.
    """

    def __init__(self, clients: int, rate: float, port: int) -> None:
        """Connect all clients."""
        self._period = 1.0 / rate
        self._poll = select.epoll()
        self._sockets = [_joined(number, port) for number in range(clients)]
        self._numbers = {each.fileno(): number for number, each in enumerate(self._sockets)}
        for each in self._sockets:
            each.setblocking(False)
            self._poll.register(each, select.EPOLLIN)
        self._sent = [0.0] * clients  # when the action that a client waits for was asked for; 0: none
        self._steps = [number * 7 for number in range(clients)]  # so that the episodes do not end together
        self._begun = [False] * clients
        self.latencies: list[float] = []
        self.lags: list[float] = []  # from the time at which an observation was due until it was sent

    def play(self, seconds: float) -> None:
        """Play; then `latencies` and `lags` are those of these seconds.

        A client whose last action has not come leaves out a step.
        """
        self.latencies, self.lags = [], []
        clients = len(self._sockets)
        step, begin = 0, time.monotonic()
        while (now := time.monotonic()) < begin + seconds:
            due = begin + step * self._period / clients
            if now < due:
                self._receive(due - now)
                continue
            self.lags.append(now - due)
            client = step % clients
            step += 1
            if not self._sent[client]:
                self._send(client)

    def _send(self, client: int) -> None:
        step = self._steps[client] = self._steps[client] + 1
        text = _ACTS[step % len(_ACTS)] if self._begun[client] else _FIRST_ACT
        if self._begun[client] and step % _EPISODE_STEPS == 0:
            text = _END + _FIRST_ACT
        self._begun[client] = True
        self._sent[client] = time.monotonic()
        self._sockets[client].send(text)

    def _receive(self, seconds: float) -> None:
        for number, _ in self._poll.poll(seconds):
            client = self._numbers[number]
            data = self._sockets[client].recv(4096)
            now = time.monotonic()
            if data[:2] == b"\x89\x04":  # a ping of the server, with four bytes
                self._sockets[client].send(b"\x8a\x84" + bytes(4) + data[2:6])
                data = data[6:]
            if not data:
                continue
            if data[0] != 0x81 or b'"action"' not in data:
                raise SystemExit(f"the gateway answered {data[:200]!r}")
            self.latencies.append(now - self._sent[client])
            self._sent[client] = 0.0

    def close(self) -> None:
        """Disconnect."""
        for each in self._sockets:
            each.close()


def _joined(number: int, port: int) -> socket.socket:
    """Return the connection of a client that has its welcome."""
    connection = socket.create_connection(("127.0.0.1", port), 60.0)
    connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    connection.sendall(_HANDSHAKE.format(port=port).encode())
    _expect(connection, b"\r\n\r\n")
    connection.sendall(frame(json.dumps({**_HELLO, "name": f"client-{number}"})))
    _expect(connection, b'"welcome"')
    return connection


def _expect(connection: socket.socket, end: bytes) -> None:
    data = b""
    while end not in data:
        data += (part := connection.recv(4096))
        if not part or b'"error"' in data:
            raise SystemExit(f"the gateway answered {data[-300:]!r}")


def drive(clients: int, rate: float, seconds: float, port: int, gateway: int) -> list[object]:
    """Return a row of the table."""
    fleet = Fleet(clients, rate, port)
    fleet.play(_WARM_SECONDS)
    before = cpu_seconds(gateway)
    fleet.play(seconds)
    used = cpu_seconds(gateway) - before
    fleet.close()
    steps = len(fleet.latencies)
    row: list[object] = ["gateway", clients, f"{steps / seconds:,.0f}"]
    row += [f"{1000 * value:.2f}" for value in np.quantile(fleet.latencies, (0.5, 0.99, 1.0))]
    return [*row, f"{1000 * used / steps:.3f}", f"{used / seconds:.0%}", f"{1000 * np.quantile(fleet.lags, 0.99):.1f}"]


_CLIENT_PROGRAM = """
import sys, threading, time
import gymnasium, numpy as np
from daedalus.actor import Client

address, clients, rate, seconds = sys.argv[1], int(sys.argv[2]), float(sys.argv[3]), float(sys.argv[4])
spaces = {
    "observation_space": gymnasium.spaces.Box(-np.inf, np.inf, (4,), np.float32),
    "action_space": gymnasium.spaces.Discrete(2),
}
latencies, begin = [], time.monotonic() + 5.0

def play(number):
    random = np.random.default_rng(number)
    with Client(address, **spaces, name=f"direct-{number}") as client:
        due = time.monotonic() + random.random() / rate
        while due < begin + seconds:
            time.sleep(max(due - time.monotonic(), 0.0))
            sent = time.monotonic()
            client.act(random.standard_normal(4, np.float32))
            client.reward(1.0)
            if sent >= begin:
                latencies.append(time.monotonic() - sent)
            due = max(due + 1 / rate, sent)

threads = [threading.Thread(target=play, args=(number,)) for number in range(clients)]
for thread in threads:
    thread.start()
time.sleep(begin - time.monotonic())
used = time.process_time()
time.sleep(seconds)
print(time.process_time() - used, len(latencies), *np.quantile(latencies, (0.5, 0.99, 1.0)))
for thread in threads:
    thread.join()
"""


def direct(clients: int, rate: float, seconds: float, address: str) -> list[object]:
    """Return the row of a process with Clients of Python."""
    words = [sys.executable, "-c", _CLIENT_PROGRAM, address, str(clients), str(rate), str(seconds)]
    output = subprocess.run(words, capture_output=True, text=True, check=True).stdout
    used, steps, *latencies = map(float, output.split())
    row = ["Client in Python", clients, f"{steps / seconds:,.0f}", *(f"{1000 * value:.2f}" for value in latencies)]
    return [*row, f"{1000 * used / steps:.3f}", f"{used / seconds:.0%}", ""]


def main() -> None:
    options = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    options.add_argument("--clients", type=int, default=200)
    options.add_argument("--rate", type=float, default=20.0, help="steps a second of each client")
    options.add_argument("--seconds", type=float, default=20.0)
    options.add_argument("--direct", type=int, default=20, help="Clients in Python; 0: leave them out")
    options.add_argument("--port", type=int, default=8123)
    parsed = options.parse_args()
    cores = sorted(os.sched_getaffinity(0))
    address = "tcp/127.0.0.1:7666"
    rows: list[list[object]] = []
    with tempfile.TemporaryDirectory() as folder:
        endless = ["--env-steps", "1000000000", "--set", "training.stop_when_solved=false"]
        learner = subprocess.Popen(
            [
                "nice",
                "-n",
                "19",
                *COMMAND,
                "learner",
                "cartpole",
                "--run-dir",
                str(Path(folder) / "run"),
                "--listen",
                address,
                *endless,
            ],
            stdout=subprocess.DEVNULL,
        )
        web = ["--listen", f"127.0.0.1:{parsed.port}", "--log-level", "warning"]
        gateway = subprocess.Popen([*COMMAND, "gateway", "--connect", address, *web])
        try:
            os.sched_setaffinity(gateway.pid, cores[:1])
            for process in (os.getpid(), learner.pid):
                os.sched_setaffinity(process, cores[1:] or cores)
            wait_for_port(parsed.port)
            rows.append(drive(parsed.clients, parsed.rate, parsed.seconds, parsed.port, gateway.pid))
            if parsed.direct:
                rows.append(direct(parsed.direct, parsed.rate, parsed.seconds, address))
        finally:
            for process in (gateway, learner):
                process.terminate()
                process.wait(20)
    print(machine())
    header = ["", "clients", "steps/s", "latency p50, ms", "p99", "max", "CPU ms per step", "of one core"]
    header.append("sent late p99, ms")
    print(table(header, rows))


def wait_for_port(port: int) -> None:
    """Wait until the gateway listens."""
    for _ in range(300):
        try:
            socket.create_connection(("127.0.0.1", port), 1).close()
            return
        except OSError:
            time.sleep(0.1)
    raise SystemExit("the gateway did not start")


if __name__ == "__main__":
    main()
