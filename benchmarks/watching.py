"""Measure what watching costs a run: env_steps/s while a page with the camera is open, and while none is.

    python -m benchmarks.watching --rounds 6 --seconds 15

The phases alternate within one run of CartPole on this machine (`daedalus train --watch`), so that slow changes of the
machine's speed affect both alike. A WebSocket stands for the page.
"""

import argparse
import json
import os
import re
import statistics
import subprocess
import tempfile
import threading
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path

from websockets.exceptions import WebSocketException
from websockets.sync.client import connect as open_socket

from benchmarks.screenshots import COMMAND, page_address
from daedalus.transport.connecting import connect
from daedalus.transport.interface import Transport
from daedalus.transport.status_query import ask

SETTINGS = ["--set", "training.stop_when_solved=false", "--env-steps", "1000000000"]


class Page:
    """A page that shows the run and the camera."""

    def __init__(self, address: str, token: str) -> None:
        self.frames, self._stop = 0, threading.Event()
        self._address, self._token = address.replace("http", "ws") + "watch", token
        self._thread = threading.Thread(target=self._watch)
        self._thread.start()

    def _watch(self) -> None:
        with open_socket(self._address, max_size=None) as socket:
            socket.send(json.dumps({"type": "hello", "token": self._token}))
            socket.send(json.dumps({"type": "camera", "on": True}))
            while not self._stop.is_set():
                try:
                    self.frames += isinstance(socket.recv(timeout=0.2), bytes)
                except TimeoutError:
                    continue
                except WebSocketException:
                    return

    def close(self) -> None:
        """Close the page."""
        self._stop.set()
        self._thread.join()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--rounds", type=int, default=6, help="pairs of phases (default: %(default)s)")
    parser.add_argument("--seconds", type=float, default=15.0, help="duration of a phase (default: %(default)s)")
    parsed = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        words = [*COMMAND, "train", "cartpole", "--watch", "--run-dir", "run", *SETTINGS]
        run = subprocess.Popen(words, cwd=folder, stdout=subprocess.PIPE, text=True)
        try:
            address = page_address(run)
            token = (Path(folder) / "run" / "operator-token").read_text().strip()
            _measure(partial(Page, address, token), learner_address(run.pid), parsed.rounds, parsed.seconds)
        finally:
            run.terminate()
            run.wait()


def learner_address(launcher: int) -> str:
    """Return the address of the learner that `daedalus train` started: another process cannot guess it."""
    for entry in Path("/proc").glob("[0-9]*"):
        words = (entry / "cmdline").read_bytes().decode().split("\0") if os.access(entry, os.R_OK) else []
        parent = re.search(r"^PPid:\s+(\d+)", (entry / "status").read_text(), re.MULTILINE) if words else None
        if parent and int(parent[1]) == launcher and "daedalus.cli.commands.learner" in words:
            return words[words.index("--listen") + 1]
    raise SystemExit("the learner was not found")


def _measure(show: Callable[[], Page], learner: str, rounds: int, seconds: float) -> None:
    transport = connect([learner])
    try:
        time.sleep(seconds)  # of the first updates
        changes, frames = [], 0
        for number in range(rounds):
            rates = {}
            for watched in (number % 2 == 0, number % 2 == 1):
                shown = show() if watched else None
                time.sleep(3.0)  # for the camera to start, or to end
                rates[watched] = _rate(transport, seconds)
                if shown is not None:
                    shown.close()
                    frames += shown.frames
            changes.append(100 * (rates[True] / rates[False] - 1))
            print(f"watched {rates[True]:,.0f} env_steps/s, not watched {rates[False]:,.0f}: {changes[-1]:+.1f} %")
    finally:
        transport.close()
    shown_per_second = frames / (rounds * (seconds + 3.0))
    print(f"median {statistics.median(changes):+.1f} %, mean {statistics.mean(changes):+.1f} %, ", end="")
    print(f"{shown_per_second:.1f} pictures/s")


def _rate(transport: Transport, seconds: float) -> float:
    def env_steps() -> int:
        return ask(transport)[0].env_steps

    first, began = env_steps(), time.monotonic()
    time.sleep(seconds)
    return (env_steps() - first) / (time.monotonic() - began)


if __name__ == "__main__":
    main()
