"""Measure a gateway: clients at a fixed rate, the latency of their actions, and the CPU time that a step costs.

    python -m benchmarks.gateway --clients 200 --rate 20 --seconds 20

A learner of the preset cartpole trains on the clients' rollouts meanwhile. The gateway has one core of its own; the
clients and the learner share another. The clients' observations are random: nothing is learned. For comparison, a
process with `daedalus.actor.Client`s plays at the same rate.
"""

import argparse
import asyncio
import json
import os
import random
import socket
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

from benchmarks.running import COMMAND, machine, table

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


class Client:
    """One client: an observation every 1 / rate seconds."""

    def __init__(self, number: int, port: int, rate: float) -> None:
        self._number, self._port, self._period = number, port, 1.0 / rate
        self.latencies: list[tuple[float, float]] = []  # time of the answer, seconds

    async def run(self, until: float) -> None:
        """Play until a monotonic time."""
        reader, writer = await asyncio.open_connection("127.0.0.1", self._port)
        writer.write(_HANDSHAKE.format(port=self._port).encode())
        await reader.readuntil(b"\r\n\r\n")
        writer.write(frame(json.dumps({**_HELLO, "name": f"client-{self._number}"})))
        await self._read(reader, writer)
        texts = [
            frame(json.dumps({"type": "act", "observation": [random.uniform(-1, 1) for _ in range(4)], "reward": 1.0}))
            for _ in range(10)
        ]
        first = frame('{"type":"act","observation":[0.01,0.02,-0.03,0.04]}')
        last = frame('{"type":"end_episode","terminated":true,"observation":[0.01,0.02,-0.03,0.04]}')
        step, due = 0, time.monotonic() + random.random() * self._period
        while due < until:
            await asyncio.sleep(max(due - time.monotonic(), 0.0))
            sent = time.monotonic()
            writer.write(first if step % _EPISODE_STEPS == 0 else texts[step % 10])
            await self._read(reader, writer)
            now = time.monotonic()
            self.latencies.append((now, now - sent))
            step += 1
            if step % _EPISODE_STEPS == 0:
                writer.write(last)
            due = max(due + self._period, now)
        writer.close()

    async def _read(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> bytes:
        while True:
            head = await reader.readexactly(2)
            size = head[1]
            if size == 126:
                size = int.from_bytes(await reader.readexactly(2), "big")
            data = await reader.readexactly(size)
            if head[0] == 0x89:  # a ping
                writer.write(b"\x8a" + bytes([0x80 | len(data)]) + bytes(4) + data)
                continue
            if b'"error"' in data or head[0] != 0x81:
                raise SystemExit(f"the gateway answered {data[:200]!r}")
            return data


def cpu_seconds(process: int) -> float:
    """Return the CPU time that a process has used."""
    fields = Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


async def drive(clients: int, rate: float, seconds: float, port: int, gateway: int) -> list[object]:
    """Return a row of the table."""
    begin = time.monotonic() + _WARM_SECONDS
    players = [Client(number, port, rate) for number in range(clients)]
    tasks = [asyncio.create_task(player.run(begin + seconds)) for player in players]
    await asyncio.sleep(max(begin - time.monotonic(), 0.0))
    before = cpu_seconds(gateway)
    await asyncio.sleep(seconds)
    used = cpu_seconds(gateway) - before
    await asyncio.gather(*tasks)
    latencies = np.array([wait for player in players for at, wait in player.latencies if at >= begin])
    p50, p99 = (f"{1000 * np.quantile(latencies, share):.2f}" for share in (0.5, 0.99))
    steps = len(latencies)
    return [
        "gateway",
        clients,
        f"{steps / seconds:,.0f}",
        p50,
        p99,
        f"{1000 * used / steps:.3f}",
        f"{used / seconds:.0%}",
    ]


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
print(time.process_time() - used, len(latencies), *np.quantile(latencies, (0.5, 0.99)))
for thread in threads:
    thread.join()
"""


def direct(clients: int, rate: float, seconds: float, address: str) -> list[object]:
    """Return the row of a process with Clients of Python."""
    words = [sys.executable, "-c", _CLIENT_PROGRAM, address, str(clients), str(rate), str(seconds)]
    output = subprocess.run(words, capture_output=True, text=True, check=True).stdout
    used, steps, p50, p99 = map(float, output.split())
    row = ["Client in Python", clients, f"{steps / seconds:,.0f}", f"{1000 * p50:.2f}", f"{1000 * p99:.2f}"]
    return [*row, f"{1000 * used / steps:.3f}", f"{used / seconds:.0%}"]


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
            [*COMMAND, "learner", "cartpole", "--run-dir", str(Path(folder) / "run"), "--listen", address, *endless],
            stdout=subprocess.DEVNULL,
        )
        web = ["--listen", f"127.0.0.1:{parsed.port}", "--log-level", "warning"]
        gateway = subprocess.Popen([*COMMAND, "gateway", "--connect", address, *web])
        try:
            os.sched_setaffinity(gateway.pid, cores[:1])
            for process in (os.getpid(), learner.pid):
                os.sched_setaffinity(process, cores[1:] or cores)
            wait_for_port(parsed.port)
            rows.append(asyncio.run(drive(parsed.clients, parsed.rate, parsed.seconds, parsed.port, gateway.pid)))
            if parsed.direct:
                rows.append(direct(parsed.direct, parsed.rate, parsed.seconds, address))
        finally:
            for process in (gateway, learner):
                process.terminate()
                process.wait(20)
    print(machine())
    header = ["", "clients", "steps/s", "latency p50, ms", "p99, ms", "CPU ms per step", "of one core"]
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
