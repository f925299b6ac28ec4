"""Test of `daedalus train` on a terminal, as a person sees it: a pseudo-terminal of 40 columns, and Ctrl-C."""

import codecs
import fcntl
import json
import os
import pty
import re
import shutil
import signal
import struct
import subprocess
import sys
import termios
import threading
import urllib.request
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from processes import ENDLESS, LIMIT, SLOW, command_line, processes_mentioning, until
from saved_runs import save
from terminal import Terminal
from websockets.exceptions import InvalidStatus
from websockets.sync.client import connect

from daedalus.protocol.spec import EnvironmentSpec

COLUMNS, LINES = 40, 20
# The program becomes the one that Ctrl-C of this terminal reaches.
AT_TERMINAL = (
    "import fcntl, os, sys, termios; fcntl.ioctl(0, termios.TIOCSCTTY, 0); os.execv(sys.argv[1], sys.argv[1:])"
)


class AtTerminal:
    """Process at a pseudo-terminal, and what the terminal shows."""

    def __init__(self, words: list[str], directory: Path, environment: dict[str, str]) -> None:
        self._master, slave = pty.openpty()
        outer = {name: value for name, value in os.environ.items() if name not in ("COLUMNS", "LINES")}  # of another
        fcntl.ioctl(slave, termios.TIOCSWINSZ, struct.pack("HHHH", LINES, COLUMNS, 0, 0))
        self.process = subprocess.Popen(
            [sys.executable, "-c", AT_TERMINAL, *words],
            cwd=directory,
            stdin=slave,
            stdout=slave,
            stderr=slave,
            start_new_session=True,
            env={**outer, "TERM": "xterm-256color", **environment},
        )
        os.close(slave)
        self.terminal = Terminal(COLUMNS)
        self.raw = b""
        self.fault: Exception | None = None
        self._reader = threading.Thread(target=self._read, daemon=True)
        self._reader.start()

    def _read(self) -> None:
        decoder = codecs.getincrementaldecoder("utf-8")()  # a read may end within a character
        try:
            while True:
                data = os.read(self._master, 1 << 16)
                self.raw += data
                self.terminal.feed(decoder.decode(data))
        except OSError:  # the process has closed the terminal
            return
        except Exception as error:
            self.fault = error

    @property
    def text(self) -> str:
        return "\n".join(self.terminal.lines)

    def type(self, keys: bytes) -> None:
        os.write(self._master, keys)

    def wait(self) -> int:
        status = self.process.wait(LIMIT)
        self._reader.join(LIMIT)
        return status

    def end(self) -> None:
        self.process.kill()
        self.process.wait(LIMIT)
        self._reader.join(LIMIT)
        os.close(self._master)


@pytest.fixture
def at_terminal(tmp_path: Path) -> Iterator[Callable[..., AtTerminal]]:
    started: list[AtTerminal] = []

    def start(*arguments: str, report: bool = False, **environment: str) -> AtTerminal:
        started.append(AtTerminal(command_line(*arguments, report=report), tmp_path, environment))
        return started[-1]

    yield start
    for one in started:
        one.end()


def child_of(parent: int, text: str) -> int:
    """Return the id of the child process of `parent` whose command line contains `text`."""
    children = set(map(int, Path(f"/proc/{parent}/task/{parent}/children").read_text().split()))
    (child,) = children & set(processes_mentioning(text))
    return child


def test_train_on_a_terminal_shows_its_actors_and_ctrl_c_leaves_a_clean_screen(
    at_terminal: Callable[..., AtTerminal], tmp_path: Path
) -> None:
    shutil.copy(Path(__file__).parent.parent / "slow_environment.py", tmp_path)
    words = ("train", "cartpole", "--run-dir", "shown-run", *map(str, (*ENDLESS, *SLOW)))
    running = at_terminal(*words, report=True)
    until(lambda: running.fault or (re.search(r"return +\d", running.text) and "actor-1  alive" in running.text))
    os.kill(child_of(running.process.pid, "actor-1"), signal.SIGKILL)
    until(lambda: running.fault or "actor-1 was killed by signal 9" in running.text)  # above the frame
    running.type(b"\x03")
    assert running.wait() == 1, running.text
    assert running.fault is None
    assert running.terminal.cursor_shown
    header = "slow_environment:Slow-v0, impala"
    assert running.text.count(header) == 1, running.text
    assert "actor-0" not in running.text
    (frame,) = [number for number, line in enumerate(running.terminal.lines) if line.startswith(header)]
    assert running.terminal.lines[frame + 2].startswith("return ")
    assert "stopped; checkpoint saved at" in "".join(running.terminal.lines[:frame])  # a long line goes on below
    left, how = "report: shown-run/report.html", "stopped; continue with: daedalus resume shown-run"
    how += " --allow-module slow_environment"
    assert "".join(running.terminal.lines[frame + 5 :]) == left + how
    assert (tmp_path / "shown-run" / "report.html").exists()
    assert not processes_mentioning("shown-run")


def test_the_page_stays_after_the_end_of_the_run_until_ctrl_c_and_is_shown_to_the_operator_only(
    at_terminal: Callable[..., AtTerminal], tmp_path: Path
) -> None:
    short = ("--env-steps", "4000", "--set", "evaluation.final_episodes=0", "--actors", "1")
    running = at_terminal("train", "cartpole", "--watch", "--run-dir", "kept-run", *short)
    until(lambda: running.fault or "press Ctrl-C to close it" in running.text.replace("\n", ""))
    port = re.search(r"http://127\.0\.0\.1:(\d+)/", running.raw.decode())
    assert port is not None
    with urllib.request.urlopen(f"http://127.0.0.1:{port[1]}/", timeout=LIMIT) as answer:
        assert answer.status == 200
    for path in ("actor", "raw"):  # without --clients
        with pytest.raises(InvalidStatus):
            connect(f"ws://127.0.0.1:{port[1]}/{path}", open_timeout=LIMIT)
    file = tmp_path / "kept-run" / "operator-token"
    assert file.stat().st_mode & 0o077 == 0
    for token, received in (("", "error"), (file.read_text().strip(), "hello")):
        with connect(f"ws://127.0.0.1:{port[1]}/watch", open_timeout=LIMIT) as page:
            page.send(json.dumps({"type": "hello", "token": token}))
            assert json.loads(page.recv(timeout=LIMIT))["type"] == received
    running.type(b"\x03")
    assert running.wait() == 3  # that of the run
    assert not processes_mentioning("kept-run")


def test_a_person_plays_the_policy_at_a_terminal_until_ctrl_c(
    at_terminal: Callable[..., AtTerminal], tmp_path: Path
) -> None:
    save(tmp_path / "run", EnvironmentSpec(id="pettingzoo.classic.tictactoe_v3"), 3)
    running = at_terminal("evaluate", "run", "--play")

    def asked() -> list[str]:
        return re.findall(r"^Your move \((.*)\):", running.text, re.MULTILINE)

    until(lambda: running.fault or "[player_1]" in running.text)
    running.type(b"player_3\n")
    until(lambda: running.fault or "There is no 'player_3'" in running.text)
    running.type(b"player_2\n")
    until(lambda: running.fault or asked())
    assert "player_1 plays" in running.text
    running.type(b"12\n")
    until(lambda: running.fault or len(asked()) == 2)
    assert "'12' is no legal move" in running.text
    for turns in range(3, 8):
        running.type(asked()[-1].split()[0].encode() + b"\n")
        until(lambda turns=turns: running.fault or len(asked()) == turns or "Another game" in running.text)
        if "Another game" in running.text:
            break
    assert re.search(r"You won|You lost|A draw", running.text), running.text
    running.type(b"\x03")
    assert running.wait() == 0, running.text
    assert running.text.rstrip().endswith("bye")
    assert running.fault is None
