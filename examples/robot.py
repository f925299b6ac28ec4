"""A robot with its own clock, behind a bad network: `python examples/robot.py tcp/127.0.0.1:7447`.

Start the learner in another terminal, on any machine:
    daedalus learner --env Arm --algorithm appo --actors 1 --set collection.rollout_length=50 \
        --set training.batch_rollouts=2

Three processes: the learner, the simulated arm with a loop of 50 Hz, and a proxy between them that delays what it
forwards, one piece in a hundred by more than 200 ms. The arm learns to reach targets. It never waits for the network:
the program prints how many of its deadlines it missed.
"""

import argparse
import asyncio
import contextlib
import logging
import math
import multiprocessing
import signal
import time
from multiprocessing.connection import Connection
from typing import Any

import gymnasium
import numpy as np

from daedalus import Client

RATE = 50.0  # ticks a second
EPISODE = 100  # ticks: two seconds
LINKS = np.array([0.5, 0.4])  # metres


class Arm:
    """Two links in a plane, whose joints follow commanded speeds."""

    observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (8,), np.float32)
    action_space = gymnasium.spaces.Box(-1.0, 1.0, (2,), np.float32)

    def __init__(self) -> None:
        self._random = np.random.default_rng()
        self._angles, self._speeds = np.array([0.5, 1.0]), np.zeros(2)
        self._target = np.zeros(2)

    def new_target(self) -> None:
        """Choose a point that the hand can reach."""
        angle, distance = self._random.uniform(0.0, 2.0 * math.pi), self._random.uniform(0.3, 0.8)
        self._target = distance * np.array([math.cos(angle), math.sin(angle)])

    @property
    def _to_target(self) -> np.ndarray:
        sums = np.cumsum(self._angles)
        return self._target - np.array([LINKS @ np.cos(sums), LINKS @ np.sin(sums)])

    def look(self) -> np.ndarray:
        """Return the angles, the speeds and the way from the hand to the target."""
        parts = [np.cos(self._angles), np.sin(self._angles), self._speeds, self._to_target]
        return np.concatenate(parts).astype(np.float32)

    def move(self, action: np.ndarray) -> float:
        """Move for one tick; return the reward: minus the distance from the target, in metres."""
        self._speeds += 0.3 * (4.0 * np.clip(action, -1.0, 1.0) - self._speeds)
        self._angles += self._speeds / RATE
        return -float(np.linalg.norm(self._to_target))


def drive(address: str, seconds: float, results: Connection) -> None:
    """Run the arm's loop, in a process of its own."""
    logging.basicConfig(level=logging.INFO, format="%(message)s")
    arm = Arm()
    client = Client(
        address,
        observation_space=arm.observation_space,
        action_space=arm.action_space,
        name="arm",
        safe_action=np.zeros(2, np.float32),  # the joints stop
        max_policy_age=30.0,
        untrained=True,  # the arm may learn from the beginning
    )
    last = int(seconds * RATE)
    with client, client.clock(RATE) as clock:
        total, returns = 0.0, []
        arm.new_target()
        for tick in range(last):
            if not clock.wait():
                break
            if tick and tick % EPISODE == 0:
                client.end_episode(terminated=False, observation=arm.look())
                returns.append(total)
                total = 0.0
                arm.new_target()
                if len(returns) % 10 == 0:
                    print(
                        f"{clock.deadlines:,} deadlines, {clock.missed_deadlines:,} missed; the last episodes "
                        f"returned {np.mean(returns[-10:]):.1f}; {client.safe_reason or 'the policy acts'}",
                        flush=True,
                    )
            reward = arm.move(client.act(arm.look()))
            client.reward(reward)
            total += reward
        results.send({"deadlines": clock.deadlines, "missed": clock.missed_deadlines, "returns": returns})


class DelayingProxy:
    """Forwards TCP connections. It delays each piece at random and keeps the order."""

    def __init__(self, target: str, p99: float) -> None:
        """`target` is HOST:PORT; `p99` the delay in seconds that one piece in a hundred exceeds."""
        self._target, self._mean = target.rsplit(":", 1), p99 / math.log(100.0)  # of an exponential distribution
        self._random = np.random.default_rng()
        self.delays: list[float] = []  # as they were, in seconds

    async def serve(self, started: Connection) -> None:
        """Serve on a free port of this machine, which is sent through `started`."""
        server = await asyncio.start_server(self._connect, "127.0.0.1", 0)
        started.send(server.sockets[0].getsockname()[1])
        async with server:
            await server.serve_forever()

    async def _connect(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        try:
            far_reader, far_writer = await asyncio.open_connection(*self._target)
        except OSError:  # there is no learner yet: the client tries again
            writer.close()
            return
        with contextlib.suppress(asyncio.CancelledError, ConnectionError):  # the end of the program or of a connection
            await asyncio.gather(self._forward(reader, far_writer), self._forward(far_reader, writer))

    async def _forward(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        pieces: asyncio.Queue[tuple[float, float, bytes]] = asyncio.Queue()
        delivery = asyncio.create_task(self._deliver(pieces, writer))
        due = 0.0
        while data := await reader.read(1 << 16):
            now = time.monotonic()
            due = max(due, now + self._random.exponential(self._mean))
            pieces.put_nowait((now, due, data))
        pieces.put_nowait((0.0, 0.0, b""))
        await delivery

    async def _deliver(self, pieces: asyncio.Queue[tuple[float, float, bytes]], writer: asyncio.StreamWriter) -> None:
        while (piece := await pieces.get())[2]:
            received, due, data = piece
            await asyncio.sleep(max(due - time.monotonic(), 0.0))
            self.delays.append(time.monotonic() - received)
            writer.write(data)
        writer.close()


def delay_network(target: str, p99: float, pipe: Connection) -> None:
    """Run the proxy, in a process of its own, until something comes through the pipe; then send the delays."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)

    async def run() -> list[float]:
        proxy = DelayingProxy(target, p99)
        serving = asyncio.create_task(proxy.serve(pipe))
        await asyncio.to_thread(pipe.recv)
        serving.cancel()
        return proxy.delays

    pipe.send(asyncio.run(run()))


def main() -> None:
    options = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    options.add_argument("address", nargs="?", default="tcp/127.0.0.1:7447", help="default: %(default)s")
    options.add_argument("--seconds", type=float, default=200.0, help="of driving (default: %(default)s)")
    options.add_argument(
        "--delay-p99", type=float, default=0.2, metavar="SECONDS", help="one piece in a hundred (default: %(default)s)"
    )
    parsed = options.parse_args()
    processes = multiprocessing.get_context("spawn")
    pipe, proxys_pipe = processes.Pipe()
    results, arms_results = processes.Pipe(duplex=False)
    target = parsed.address.split("/", 1)[1]
    proxy: Any = processes.Process(target=delay_network, args=(target, parsed.delay_p99, proxys_pipe), daemon=True)
    proxy.start()
    address = f"tcp/127.0.0.1:{pipe.recv()}"
    arm: Any = processes.Process(target=drive, args=(address, parsed.seconds, arms_results), daemon=True)
    arm.start()
    arms_results.close()
    try:
        found = results.recv()
    except EOFError:
        raise SystemExit("the arm's process failed") from None
    arm.join()
    pipe.send(None)
    delays = np.array(pipe.recv())
    print(
        f"{found['missed']:,} of {found['deadlines']:,} deadlines missed; delays of the network: "
        f"median {1000 * np.median(delays):.0f} ms, p99 {1000 * np.percentile(delays, 99):.0f} ms, each way"
    )


if __name__ == "__main__":
    main()
