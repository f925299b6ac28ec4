"""One service under measurement: its processes, the status of its learner, and waiting times."""

import contextlib
import json
import os
import random
import signal
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from processes import Running, free_address, processes_mentioning

from benchmarks.running import COMMAND
from daedalus.protocol import keys
from daedalus.protocol.codec import ProtocolError, decode
from daedalus.protocol.limits import Limits
from daedalus.protocol.messages import ActorStatus, RunStatus, StatusReport
from daedalus.transport.interface import Transport, TransportError
from daedalus.transport.zenoh_transport import connect

ENDLESS = ("--set", "training.stop_when_solved=false", "--env-steps", 10**9)
LIMIT = 120.0  # seconds; timeout of each step
_POLL_SECONDS = 0.02


class FailedError(Exception):
    """Error of a service that did not behave as documented."""


class Scene:
    """Processes in a temporary folder, and the address of their learner."""

    def __init__(self) -> None:
        self._folder = tempfile.TemporaryDirectory()
        self.folder = Path(self._folder.name)
        self.address = free_address()
        self._running: list[Running] = []
        self._transport: Transport | None = None

    def start(self, *arguments: object) -> Running:
        """Start `daedalus ARGUMENTS`."""
        return self.run([*COMMAND, *map(str, arguments)])

    def run(self, command: Sequence[str], directory: Path | None = None) -> Running:
        """Start a command in a directory (default: the temporary folder)."""
        self._running.append(Running(list(command), directory or self.folder))
        return self._running[-1]

    def router(self) -> Running:
        """Start a router at the address."""
        running = self.start("router", "--listen", self.address)
        running.expect("listening")
        return running

    def status(self) -> RunStatus | None:
        """Return the status of the learner, or None if it does not answer."""
        try:
            if self._transport is None:
                self._transport = connect([self.address])
            answers = self._transport.query(keys.status("*"), timeout=2.0)
            report = decode(answers[0], Limits()) if answers else None
        except (TransportError, ProtocolError):
            return None
        return report.status if isinstance(report, StatusReport) else None

    def actor(self, name: str) -> ActorStatus | None:
        """Return the status of one actor, or None."""
        status = self.status()
        return next((each for each in status.actors if each.actor == name), None) if status else None

    def env_steps(self, *names: str) -> int:
        """Return the env_steps trained on, of the named actors or of the whole run."""
        status = self.status()
        if status is None:
            return 0
        return sum(each.env_steps for each in status.actors if each.actor in names) if names else status.env_steps

    def wait(self, description: str, condition: Callable[[], object]) -> float:
        """Wait until a condition holds; return the seconds. Raises FailedError after LIMIT seconds."""
        began = time.monotonic()
        while not condition():
            if time.monotonic() > began + LIMIT:
                output = "\n".join(running.output[-2000:] for running in self._running)
                raise FailedError(f"{description}: not within {LIMIT:g} s\n{output}")
            time.sleep(_POLL_SECONDS)
        return time.monotonic() - began

    def wait_for_training(self, *names: str) -> float:
        """Wait until new rollouts of the named actors, or any, are trained on; return the seconds."""
        before = self.env_steps(*names)
        return self.wait(f"training of {names or 'all'}", lambda: self.env_steps(*names) > before)

    def find_process(self, *texts: str) -> int | None:
        """Return the id of the one process of this scene whose command line contains all texts, or None."""
        mentioning = (set(processes_mentioning(text)) for text in texts)
        found = set.intersection(set(self._process_ids()), *mentioning)
        return found.pop() if len(found) == 1 else None

    def process(self, *texts: str) -> int:
        """Wait for that process; return its id."""
        self.wait(f"one process of {texts}", lambda: self.find_process(*texts))
        found = self.find_process(*texts)
        assert found is not None
        return found

    def _process_ids(self) -> Iterator[int]:
        """Yield the ids of the processes that were started here, and of those that they started."""
        waiting = [running.process.pid for running in self._running]
        while waiting:
            yield (process := waiting.pop())
            with contextlib.suppress(OSError):  # it ends meanwhile
                for children in Path(f"/proc/{process}/task").glob("*/children"):
                    waiting += map(int, children.read_text().split())

    def close(self) -> None:
        """End all processes."""
        if self._transport is not None:
            self._transport.close()
        for running in self._running:  # launchers first: they end their child processes
            with contextlib.suppress(ProcessLookupError):
                os.kill(running.process.pid, signal.SIGCONT)
                running.process.terminate()
        for running in self._running:
            with contextlib.suppress(Exception):
                running.process.wait(10.0)
            running.end()
        self._folder.cleanup()


class JournalActors:
    """Actors that write journals of what they send (journal.py); one after the other is killed and started again."""

    def __init__(self, here: Scene, count: int, words: Sequence[str] = ()) -> None:
        """Start them, and wait until all are trained on. `words` are further ones of journal.py.

        The first actor sends all rollouts twice.
        """
        self._here, self._words, self._kills = here, words, 0
        self._names = [f"actor-{number}" for number in range(count)]
        self._running = {name: self._started(name) for name in self._names}
        here.wait_for_training(*self._names)

    def _started(self, name: str) -> Running:
        journal = [sys.executable, str(Path(__file__).with_name("journal.py")), self._here.address, name]
        twice = ("twice",) if name == self._names[0] else ()
        return self._here.run(
            [*journal, str(self._here.folder / f"journal-{name}-{self._kills}"), *self._words, *twice]
        )

    def kill_one(self, choose: random.Random) -> str:
        """Kill one within two seconds, and return its name once it is back and trained on."""
        name = choose.choice(self._names)
        time.sleep(choose.uniform(0.0, 2.0))
        self._running[name].process.kill()
        self._running[name].wait()
        self._kills += 1
        self._running[name] = self._started(name)
        self._here.wait_for_training(name)
        return name

    def end(self) -> None:
        """Let all leave, and wait until the learner has decoded what they sent."""
        for actor in self._running.values():
            actor.process.terminate()
        for actor in self._running.values():
            actor.wait()
        here = self._here
        here.wait("all actors gone", lambda: (now := here.status()) is not None and not now.actors_alive)
        here.wait("the end of the queue", lambda: (now := here.status()) is not None and not now.queue_bytes)

    def lines(self) -> list[str]:
        """Return the lines of all journals."""
        return [line for path in self._here.folder.glob("journal-*") for line in path.read_text().splitlines()]


@contextlib.contextmanager
def scene() -> Iterator[Scene]:
    """Create a Scene and close it at the end, also after SIGTERM: its processes must not stay."""
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    made = Scene()
    try:
        yield made
    finally:
        made.close()


def resident_mib(pid: int) -> float:
    """Return the resident memory of a process, in MiB."""
    for line in Path(f"/proc/{pid}/status").read_text().splitlines():
        if line.startswith("VmRSS"):
            return int(line.split()[1]) / 1024
    return 0.0


def seconds(values: Sequence[float]) -> str:
    """Return the median and the maximum as text."""
    return f"median {np.median(values):.2f} s, worst {max(values):.2f} s of {len(values)}"


def say(text: str) -> None:
    """Print a line of progress to standard error."""
    print(text, file=sys.stderr, flush=True)


def read_json(path: Path) -> dict[str, Any]:
    """Return the content of a JSON file."""
    return json.loads(path.read_text())
