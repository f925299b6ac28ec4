"""A robot with its own clock, behind a bad network, learns to put a peg into a hole from a few examples and some help.

In the folder `examples`, show it ten times, and start the learner, on any machine:

    daedalus record --env robot:Arm --by robot:Person --episodes 10 --out ./shown
    daedalus learner --env robot:Arm --algorithm sac --demonstrations ./shown --actors 1 \
        --set training.updates_per_env_step=2 --set training.n_step=5 --set training.discount_factor=0.98 \
        --set policy.hidden=[64,64] --set training.minibatch_rows=128 --set training.replay_begin=200

In another terminal:

    python robot.py tcp/127.0.0.1:7447

The only reward is that of success, which random motions never reach. Whoever watches the arm takes over where it has
not succeeded after a second, ever less often. Between the arm and the learner is a proxy that delays what it
forwards, one piece in a hundred by more than 200 ms, and cuts all connections every 30 seconds. The arm never waits for
the network: the program prints how many of its deadlines of 50 Hz it missed.

With `robot:Camera`, and `--camera` of this program, the arm sees a picture in place of numbers. An update then takes
ten times as long: use a learner with cores of its own, or a GPU. Replace `policy.hidden`, and add two settings:

        --set policy.hidden=[256,256] --set environment.frame_stack=1 --set training.precision=bfloat16
"""

import argparse
import asyncio
import contextlib
import logging
import math
import multiprocessing
import signal
import sys
import time
from collections import deque
from multiprocessing.connection import Connection
from typing import Any

import gymnasium
import numpy as np

from daedalus import Client

RATE = 50.0  # ticks a second
EPISODE = 100  # ticks: two seconds
PATIENCE = 50  # ticks before somebody helps
HALF_WIDTH, DEPTH = 0.02, 0.08  # of the hole, in metres
SPEED = 0.5  # metres a second
REWARD = 100.0  # of success
SIDE, HIGH = 48, 38  # pixels of a picture, and those above the plate
PIXEL = 0.0125  # metres
CUT_SECONDS = 30.0  # between cuts of the network


class Arm(gymnasium.Env):
    """An arm that moves a peg above a plate with a hole, at commanded speeds, and stops where it hits the plate."""

    observation_space: gymnasium.Space = gymnasium.spaces.Box(-np.inf, np.inf, (4,), np.float32)
    action_space = gymnasium.spaces.Box(-1.0, 1.0, (2,), np.float32)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Lift the peg; the hole is somewhere else."""
        super().reset(seed=seed)
        self.hole = self.np_random.uniform(-0.2, 0.2)
        self.peg = np.array([self.np_random.uniform(-0.2, 0.2), 0.35])  # its tip, to the right and above the plate
        self.speeds, self.ticks = np.zeros(2), 0
        return self.look(), {}

    def look(self) -> np.ndarray:
        """Return where the tip is, from the hole, and how fast it moves."""
        return np.array([self.peg[0] - self.hole, self.peg[1], *self.speeds], np.float32)

    def step(self, action: np.ndarray) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """Move for one tick. The episode ends when the peg is in the hole or hits the plate, or after two seconds."""
        self.ticks += 1
        self.speeds += 0.5 * (SPEED * np.clip(action, -1.0, 1.0) - self.speeds)
        inside = self.peg[1] < 0.0
        self.peg = np.clip(self.peg + self.speeds / RATE, [-0.28, -DEPTH], [0.28, 0.4])
        if inside:
            self.peg[0] = np.clip(self.peg[0], self.hole - HALF_WIDTH, self.hole + HALF_WIDTH)
        success = bool(self.peg[1] <= -DEPTH)
        hits = self.peg[1] < 0.0 and bool(abs(self.peg[0] - self.hole) > HALF_WIDTH)
        over = success or hits
        return self.look(), REWARD * success, over, self.ticks >= EPISODE and not over, {}


class Camera(Arm):
    """The same arm, seen as a picture: the peg is white, the plate grey."""

    observation_space = gymnasium.spaces.Box(0, 255, (SIDE, SIDE, 1), np.uint8)

    def look(self) -> np.ndarray:
        """Return the picture."""
        pixels = np.arange(SIDE)
        row, column, hole = HIGH - self.peg[1] / PIXEL, SIDE / 2 + self.peg[0] / PIXEL, SIDE / 2 + self.hole / PIXEL
        peg = np.outer(_covered(pixels, row - 4.0, 4.0), _covered(pixels, column, 1.0))
        plate = np.outer(pixels >= HIGH, 1.0 - _covered(pixels, hole, HALF_WIDTH / PIXEL))
        return np.maximum(255.0 * peg, 96.0 * plate).astype(np.uint8)[..., None]


def _covered(pixels: np.ndarray, centre: float, half: float) -> np.ndarray:
    """Return how much of each pixel is covered from `centre` - `half` to `centre` + `half`."""
    return np.clip(half + 0.5 - np.abs(pixels - centre), 0.0, 1.0)


class Person:
    """Who shows the task, and helps: goes above the hole, then down, a little shakily."""

    def __init__(self) -> None:
        self._random = np.random.default_rng()

    def reset(self, agent: str, seed: int) -> None:
        """Begin an episode."""
        self._random = np.random.default_rng(seed)

    def act(self, observation: np.ndarray, action_mask: Any = None) -> np.ndarray:
        """Return the action for what the arm or the camera sees."""
        if observation.ndim == 1:
            aside, height = observation[:2]
        else:
            white, grey = observation[..., 0] > 96, observation[-1, :, 0]
            rows, columns = np.nonzero(white)
            aside = PIXEL * (columns.mean() - np.average(np.arange(SIDE), weights=96 - np.minimum(grey, 96)))
            height = PIXEL * (HIGH - rows.max())
        over = abs(aside) < HALF_WIDTH / 2 or height < 0.0
        wanted = np.array([-10.0 * aside, -1.0 if over else 5.0 * (0.1 - height)])
        return np.clip(wanted + self._random.normal(0.0, 0.1, 2), -1.0, 1.0).astype(np.float32)


def drive(address: str, options: argparse.Namespace, results: Connection) -> None:
    """Run the arm's loop, in a process of its own."""
    signal.signal(signal.SIGINT, lambda *_: sys.exit(1))  # Ctrl-C, without a traceback
    logging.basicConfig(level=logging.INFO, format="%(message)s")
    arm, person = Camera() if options.camera else Arm(), Person()
    client = Client(
        address,
        observation_space=arm.observation_space,
        action_space=arm.action_space,
        name="arm",
        safe_action=np.zeros(2, np.float32),  # the peg stops
        max_policy_age=30.0,
        untrained=True,  # the arm may learn from the beginning
    )
    alone: deque[bool] = deque(maxlen=20)  # of the newest episodes without help, which succeeded
    episodes, helped = 0, 0
    last, random = int(options.seconds * RATE), np.random.default_rng()
    with client, client.clock(RATE) as clock:
        observation, _ = arm.reset()
        watched = not options.no_help
        while clock.wait() and clock.deadlines < last:
            helps = watched and arm.ticks >= PATIENCE
            action = client.act(observation, override=person.act(observation) if helps else None)
            observation, reward, is_over, is_late, _ = arm.step(action)
            if not (is_over or is_late):
                continue
            if success := reward > 0.0:
                client.success(REWARD, observation)
            else:
                client.end_episode(terminated=is_over, observation=observation)
            episodes, helped = episodes + 1, helped + helps
            if not helps:
                alone.append(success)
            if episodes % 20 == 0:
                print(
                    f"{clock.deadlines:,} deadlines, {clock.missed_deadlines:,} missed; {episodes} episodes, {helped} "
                    f"with help; {sum(alone)} of the last {len(alone)} without succeeded; "
                    f"{client.safe_reason or 'the policy acts'}",
                    flush=True,
                )
            observation, _ = arm.reset()
            # Whoever watches the arm looks away ever more often: an episode without help shows what it can do.
            watched = not options.no_help and random.random() < 0.5 * (1.0 - np.mean(alone or [0.0]))
        results.send({"deadlines": clock.deadlines, "missed": clock.missed_deadlines, "alone": [*alone]})


class DelayingProxy:
    """Forwards TCP connections. It delays each piece at random, keeps the order, and cuts all connections at times."""

    def __init__(self, target: str, p99: float) -> None:
        """`target` is HOST:PORT; `p99` the delay in seconds that one piece in a hundred exceeds."""
        self._open: set[asyncio.StreamWriter] = set()
        self._target, self._mean = target.rsplit(":", 1), p99 / math.log(100.0)  # of an exponential distribution
        self._random = np.random.default_rng()
        self.delays: list[float] = []  # as they were, in seconds

    async def serve(self, started: Connection) -> None:
        """Serve on a free port of this machine, which is sent through `started`."""
        server = await asyncio.start_server(self._connect, "127.0.0.1", 0)
        started.send(server.sockets[0].getsockname()[1])
        async with server:
            while True:
                await asyncio.sleep(CUT_SECONDS)
                for each in self._open:
                    each.close()

    async def _connect(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        try:
            far_reader, far_writer = await asyncio.open_connection(*self._target)
        except OSError:  # there is no learner yet: the client tries again
            writer.close()
            return
        self._open |= {writer, far_writer}
        with contextlib.suppress(asyncio.CancelledError, ConnectionError):  # the end of the program or of a connection
            await asyncio.gather(self._forward(reader, far_writer), self._forward(far_reader, writer))
        self._open -= {writer, far_writer}

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
            if not writer.is_closing():  # else asyncio would warn
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
    options.add_argument("--seconds", type=float, default=300.0, help="of driving (default: %(default)s)")
    options.add_argument("--camera", action="store_true", help="the arm sees a picture")
    options.add_argument("--no-help", action="store_true", help="nobody takes over")
    options.add_argument(
        "--delay-p99", type=float, default=0.2, metavar="SECONDS", help="one piece in a hundred (default: %(default)s)"
    )
    parsed = options.parse_args()
    target = parsed.address.removeprefix("tcp/")
    if not target.rpartition(":")[2].isdigit() or "/" in target:
        options.error(f"{parsed.address} is not tcp/HOST:PORT")
    processes = multiprocessing.get_context("spawn")
    pipe, proxys_pipe = processes.Pipe()
    results, arms_results = processes.Pipe(duplex=False)
    proxy: Any = processes.Process(target=delay_network, args=(target, parsed.delay_p99, proxys_pipe), daemon=True)
    proxy.start()
    address = f"tcp/127.0.0.1:{pipe.recv()}"
    arm: Any = processes.Process(target=drive, args=(address, parsed, arms_results), daemon=True)
    arm.start()
    arms_results.close()
    try:
        found = results.recv()
    except EOFError:
        raise SystemExit("the arm's process failed") from None
    except KeyboardInterrupt:
        arm.join()
        raise SystemExit("stopped") from None
    arm.join()
    pipe.send(None)
    delays = np.array(pipe.recv())
    print(
        f"{found['missed']:,} of {found['deadlines']:,} deadlines missed; delays of the network: "
        f"median {1000 * np.median(delays):.0f} ms, p99 {1000 * np.percentile(delays, 99):.0f} ms, each way; "
        f"{sum(found['alone'])} of the last {len(found['alone'])} episodes without help succeeded"
    )


if __name__ == "__main__":
    main()
