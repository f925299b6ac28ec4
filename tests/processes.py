"""Processes under test: start them, wait for their output, and find processes that are left."""

import io
import itertools
import os
import re
import shutil
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, redirect_stderr, redirect_stdout, suppress
from dataclasses import dataclass
from pathlib import Path

from daedalus.cli.command_table import COMMANDS

DAEDALUS = [sys.executable, "-P", "-c", "from daedalus.cli.main import main; raise SystemExit(main())"]
# The same without the report at the end of a training, as on a machine without matplotlib: its import takes a tenth of
# the time of a short one.
NO_REPORT = [*DAEDALUS[:-1], f"import sys; sys.modules['matplotlib'] = None; {DAEDALUS[-1]}"]
LIMIT = 300.0  # seconds; timeout of each step, long enough for a slow machine with much other work
ENDLESS = ("--set", "training.stop_when_solved=false", "--env-steps", 10**9)
# CartPole whose steps wait: a run that goes on while a test waits for something else leaves it the processor.
SLOW = (
    *("--set", "environment.id=slow_environment:Slow-v0", "--set", "environment.processes=false"),
    *("--set", "collection.envs_per_actor=2", "--set", "collection.rollout_length=16"),
)
PLAYING_SLOW = ("--allow-module", "slow_environment")  # of its actors
_first_port = 20_000 + int(os.environ.get("PYTEST_XDIST_WORKER", "gw0").removeprefix("gw")) % 10 * 1000
_port_numbers = itertools.count(os.getpid())  # another run of the tests begins elsewhere


class Running:
    """Process under test, and the lines that it printed."""

    def __init__(self, arguments: list[str], directory: Path) -> None:
        self.process = subprocess.Popen(
            arguments,
            cwd=directory,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
        )
        self.lines: list[str] = []
        self._changed = threading.Condition()
        self._ended = False
        self._reader = threading.Thread(target=self._read, daemon=True)
        self._reader.start()

    def _read(self) -> None:
        assert self.process.stdout is not None
        for line in self.process.stdout:
            with self._changed:
                self.lines.append(line.rstrip("\n"))
                self._changed.notify_all()
        with self._changed:
            self._ended = True
            self._changed.notify_all()

    @property
    def output(self) -> str:
        return "\n".join(self.lines)

    def expect(self, pattern: str) -> re.Match[str]:
        """Wait for a line that matches and return the match."""

        def found() -> re.Match[str] | None:
            return next((match for line in self.lines if (match := re.search(pattern, line))), None)

        with self._changed:
            self._changed.wait_for(lambda: found() or self._ended, LIMIT)
            match = found()
        assert match, f"no line matches {pattern!r} in:\n{self.output}"
        return match

    def wait(self) -> int:
        """Wait for the end of the process and its output; return the exit status."""
        status = self.process.wait(LIMIT)
        self._reader.join(LIMIT)
        return status

    def end(self) -> None:
        self.process.kill()
        self.process.wait(LIMIT)
        self._reader.join(LIMIT)
        assert self.process.stdout is not None
        self.process.stdout.close()


@dataclass(frozen=True)
class Ended:
    """Exit status of a command, and the lines that it printed."""

    status: int
    lines: list[str]

    def expect(self, pattern: str) -> None:
        assert any(re.search(pattern, line) for line in self.lines), f"no line matches {pattern!r} in: {self.lines}"


def here(command: str, *arguments: object) -> Ended:
    """Run `daedalus COMMAND ARGUMENTS` in this process: a new one would import for half a second first."""
    output = io.StringIO()
    with redirect_stdout(output), redirect_stderr(output):
        status = COMMANDS[command].run([*map(str, arguments)])
    return Ended(status, output.getvalue().splitlines())


def command_line(*arguments: object, report: bool = True) -> list[str]:
    """Return the words that start `daedalus ARGUMENTS`.

    Where `daedalus` replaces itself by the process of the command, these are the words of that process: two
    interpreters would start otherwise. test_main.py tests the replacement.
    """
    command, *rest = map(str, arguments)
    if command in COMMANDS and not COMMANDS[command].function:
        return [sys.executable, "-P", "-m", f"daedalus.cli.commands.{command}", *rest]
    first = DAEDALUS if report or command not in ("train", "resume") else NO_REPORT
    return [*first, command, *rest]


@contextmanager
def starting(folder: Path) -> Iterator[Callable[..., Running]]:
    """Give a function that starts `daedalus ARGUMENTS` in the folder. Processes left are killed at the end."""
    shutil.copy(Path(__file__).parent / "slow_environment.py", folder)
    running: list[Running] = []

    def start(
        *arguments: object, directory: Path = folder, command: list[str] | None = None, report: bool = False
    ) -> Running:
        words = command_line(*arguments, report=report) if command is None else [*command, *map(str, arguments)]
        running.append(Running(words, directory))
        return running[-1]

    try:
        yield start
    finally:
        for one in running:
            one.end()


def free_address() -> str:
    """Return a loopback address that no process listens on.

    The port is below those that the system gives to sockets without one, and each worker has its own: until the process
    under test listens there, which takes seconds, no other socket takes it.
    """
    for number in itertools.islice(_port_numbers, 1000):
        port = _first_port + number % 1000
        with socket.socket() as probe, suppress(OSError):
            probe.bind(("127.0.0.1", port))
            return f"tcp/127.0.0.1:{port}"
    raise AssertionError("no free port")


def until(condition: Callable[[], object]) -> None:
    """Check a condition repeatedly until it holds."""
    deadline = time.monotonic() + LIMIT
    while not condition():
        assert time.monotonic() < deadline, f"the condition did not hold within {LIMIT:g} s"
        time.sleep(0.1)


def processes_mentioning(text: str) -> list[int]:
    """Return the ids of all other processes whose command line contains `text`."""
    found = []
    for entry in Path("/proc").iterdir():
        if entry.name.isdigit() and int(entry.name) != os.getpid():
            try:
                command = (entry / "cmdline").read_bytes()
            except OSError:
                continue
            if text.encode() in command:
                found.append(int(entry.name))
    return found


def is_nothing_left(output: str) -> bool:
    """Return whether the socket of a finished `daedalus train` is gone, and the processes that connected to it."""
    socket_file = output.split("unixsock-stream/")[1].split(";")[0]
    folder = Path(socket_file).parent
    return not folder.exists() and not processes_mentioning(str(folder))


def listening_ports(pid: int) -> list[int]:
    """Return the TCP ports where a process listens."""
    own: set[str] = set()
    for entry in Path(f"/proc/{pid}/fd").iterdir():
        with suppress(FileNotFoundError):  # closed meanwhile
            own.add(os.readlink(entry))
    lines = [
        line.split() for name in ("tcp", "tcp6") for line in Path(f"/proc/{pid}/net/{name}").read_text().splitlines()
    ]
    listening = [words for words in lines if words[3] == "0A" and f"socket:[{words[9]}]" in own]
    return [int(words[1].rpartition(":")[2], 16) for words in listening]
