"""Ctrl-C in the first seconds of a process, which is still importing its modules then."""

import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from daedalus.launch.child_output import Streams
from daedalus.launch.supervision import start

SECONDS = 60.0  # generous for slow machines
# In place of a command: it imports until the test writes a line, then it has handlers.
WAITING = """
import sys
print("importing", flush=True)
sys.stdin.readline()
from daedalus.launch.process_lifecycle import stop_on_signals
print("stopped" if stop_on_signals().wait(60.0) else "not stopped", flush=True)
"""
PROGRAM = """
import os, sys
from daedalus.cli import main
execv = os.execv
os.execv = lambda program, line: execv(program, [*line[:3], "waiting"])  # in place of the module of the command
sys.argv[1:] = ["evaluate"]
sys.exit(main.main())
"""


def of_the_shell() -> "subprocess.Popen[bytes]":
    return subprocess.Popen([sys.executable, "-c", PROGRAM], stdin=subprocess.PIPE, stdout=subprocess.PIPE)


def of_the_launcher() -> "subprocess.Popen[bytes]":
    return start("waiting", streams=Streams(stdout=subprocess.PIPE))


@pytest.mark.parametrize("begin", [of_the_shell, of_the_launcher])
def test_ctrl_c_before_the_handlers_stops_the_process_in_order(
    begin: Callable[[], "subprocess.Popen[bytes]"], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "waiting.py").write_text(WAITING)
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    with begin() as process:
        try:
            assert process.stdin is not None
            assert process.stdout is not None
            assert process.stdout.readline() == b"importing\n"
            process.send_signal(signal.SIGINT)
            process.stdin.write(b"\n")
            process.stdin.flush()
            assert process.stdout.readline() == b"stopped\n"
            assert process.wait(SECONDS) == 0
        finally:
            process.kill()
    assert signal.SIGINT not in signal.pthread_sigmask(signal.SIG_BLOCK, [])


# In place of a command without handlers: Ctrl-C arrives in code that replaces KeyboardInterrupt, as pydantic does, or a
# signal arrives in a callback whose exceptions Python drops, as those of the import system.
RAISING = """
import signal, sys, time, types, weakref
signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell ignores SIGINT in jobs of its background
from daedalus.cli import main

def replacing():
    try:
        signal.raise_signal(signal.SIGINT)
    except KeyboardInterrupt as error:
        raise ValueError("cannot build the validator") from error

def dropping():
    held = {"an object"}
    weak = weakref.ref(held, lambda _: signal.raise_signal(signal.SIGINT))
    del held
    time.sleep(1000)

def dropping_in_the_background():
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, signal.default_int_handler)  # as train, resume and sweep do
    held = {"an object"}
    weak = weakref.ref(held, lambda _: signal.raise_signal(signal.SIGTERM))
    del held
    time.sleep(1000)

def build(_arguments):
    BUILD()

main.COMMANDS["plot"] = types.SimpleNamespace(function="build", load=lambda: build)
sys.argv[1:] = ["plot"]
sys.exit(main.main())
"""


@pytest.mark.parametrize("build", ["replacing", "dropping", "dropping_in_the_background"])
def test_an_interrupt_that_is_replaced_by_another_exception_or_dropped_ends_the_command(build: str) -> None:
    words = [sys.executable, "-c", RAISING.replace("BUILD", build)]
    ended = subprocess.run(words, capture_output=True, text=True, timeout=SECONDS, check=False)
    assert (ended.returncode, ended.stdout, ended.stderr) == (1, "", "stopped\n")


# A connection attempt of Zenoh, which Ctrl-C does not interrupt and which lasts for ever here.
CONNECTING = """
import signal, sys, threading
signal.signal(signal.SIGINT, signal.default_int_handler)
from daedalus.cli import main
from daedalus.transport import connecting

def connect(*_):
    print("connecting", flush=True)
    while True:
        try:
            threading.Event().wait()
        except KeyboardInterrupt:
            pass

connecting.connect = connect
sys.exit(main.main())
"""


@pytest.mark.parametrize(
    ("command", "said"),
    [(["status"], "stopped\n"), (["status", "--watch"], ""), (["drain", "box"], "stopped\n")],
)
def test_ctrl_c_ends_a_command_that_waits_for_a_host(command: list[str], said: str) -> None:
    with subprocess.Popen(
        [sys.executable, "-c", CONNECTING, *command, "--connect", "tcp/127.0.0.1:7447"],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    ) as process:
        try:
            assert process.stdout is not None
            assert process.stderr is not None
            assert process.stdout.readline() == "connecting\n"
            process.send_signal(signal.SIGINT)
            assert process.wait(SECONDS) == (0 if command == ["status", "--watch"] else 1)
            assert process.stderr.read() == said
        finally:
            process.kill()
