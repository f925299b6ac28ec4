"""SIGTERM ends a process, also one whose main thread is in a call that does not return."""

import signal
import subprocess
import sys
import textwrap
from pathlib import Path

import pytest

SECONDS = 60.0  # generous for slow machines; a process that ignores the signal would never end

PREAMBLE = """
    import os, sys, threading
    from daedalus.launch import process_lifecycle
"""
# A second lock of the same mutex never returns, and releases the interpreter's lock while it waits.
STUCK = """
    import ctypes
    process_lifecycle.stop_on_signals(exit_if_stuck=True, stuck_seconds=0.2)
    libc, mutex = ctypes.CDLL(None), ctypes.create_string_buffer(128)
    print("ready", flush=True)
    while True:
        libc.pthread_mutex_lock(mutex)
"""
# A call that Python repeats after each signal, such as a read of a simulator's answer.
STUCK_IN_PYTHON = """
    import time
    process_lifecycle.stop_on_signals(exit_if_stuck=True, stuck_seconds=0.2, end_seconds=1000.0)
    print("ready", flush=True)
    time.sleep(1000)
"""
# Once the watch has seen that the main thread has noticed the stop, it allows the end more time, and sleeps for it.
SEEN = """
    import functools, hashlib, operator, time, types
    def sleep(seconds):
        if seconds == process_lifecycle._END_SECONDS:
            seen.release()
        time.sleep(seconds)
    seen = threading.Lock()
    seen.acquire()
    process_lifecycle.time = types.SimpleNamespace(monotonic=time.monotonic, sleep=sleep)
    # Even a busy machine notices the stop within 40 s.
    stop = process_lifecycle.stop_on_signals(exit_if_stuck=True, stuck_seconds=40.0)
    process_lifecycle.exit_with_parent(stop)
    print("ready", flush=True)
"""
SLOW_END = f"""{SEEN}
    stop.wait()
    seen.acquire()
    os._exit(8)
"""
# Between two calls of native code the interpreter calls no handlers, and a signal that comes during the first does not
# interrupt the wait.
NATIVE_THEN_WAIT = f"""{SEEN}
    busy = functools.partial(hashlib.pbkdf2_hmac, "sha256", b"", b"", 1_000_000)
    list(map(operator.call, (busy, stop.wait)))
    seen.acquire()
    os._exit(8)
"""
SEEN_BY_A_THREAD = """
    import ctypes
    stop = process_lifecycle.stop_on_signals()
    threading.Thread(target=lambda: (stop.wait(), os._exit(7))).start()
    libc, mutex = ctypes.CDLL(None), ctypes.create_string_buffer(128)
    print("ready", flush=True)
    while True:
        libc.pthread_mutex_lock(mutex)
"""
MANY = """
    import signal
    stop = process_lifecycle.stop_on_signals()
    storm = threading.Thread(target=lambda: [os.kill(os.getpid(), signal.SIGTERM) for _ in range(20_000)])
    print("ready", flush=True)
    stop.wait()
    storm.start()
    while storm.is_alive():
        stop.wait(0.001)
    os._exit(9)
"""
CHILD = """
    import signal, time
    stop = process_lifecycle.stop_on_signals()
    reading, writing = os.pipe()
    child = os.fork()
    if child == 0:
        signal.signal(signal.SIGTERM, lambda *_: os.write(writing, b"handled"))
        os.write(writing, b"forked.")
        while True:
            time.sleep(1000)
    assert os.read(reading, 7) == b"forked."
    os.kill(child, signal.SIGTERM)
    assert os.read(reading, 7) == b"handled"
    os.kill(child, signal.SIGKILL)
    os.waitpid(child, 0)
    print("ready" if not stop.wait(0.1) else "stopped by the signal of its child", flush=True)
    stop.wait()
"""

# Nobody reads standard output, and the main thread holds the lock of the log while it writes there.
BLOCKED_OUTPUT = """
    import logging
    from daedalus.launch.logs import configure_logging
    process_lifecycle.stop_on_signals(exit_if_stuck=True, stuck_seconds=0.2)
    configure_logging(process="actor")
    os.write(1, b"ready\\n")
    os.set_blocking(1, False)
    try:
        while True:
            os.write(1, bytes(1))
    except BlockingIOError:
        os.set_blocking(1, True)
    logging.getLogger("daedalus").error("an error that nobody reads")
"""


@pytest.mark.parametrize(
    ("program", "by_signal", "status"),
    [
        (STUCK, True, 1),
        (STUCK_IN_PYTHON, True, 1),
        (SLOW_END, True, 8),
        (SLOW_END, False, 8),
        (NATIVE_THEN_WAIT, True, 8),
        (SEEN_BY_A_THREAD, True, 7),
        (MANY, True, 9),
        (CHILD, True, 0),
        (BLOCKED_OUTPUT, True, 1),
    ],
    ids=[
        "stuck",
        "stuck in Python",
        "slow end",
        "slow end after the parent",
        "wait",
        "seen by a thread",
        "many signals",
        "child",
        "blocked output",
    ],
)
def test_signal_is_seen_in_native_code_and_only_by_its_process(program: str, by_signal: bool, status: int) -> None:
    command = [sys.executable, "-c", textwrap.dedent(PREAMBLE) + textwrap.dedent(program)]
    with subprocess.Popen(command, bufsize=0, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as process:
        try:
            assert process.stdin is not None
            assert process.stdout is not None
            assert process.stdout.readline() == b"ready\n"  # and no more: the rest stays in the pipe
            if by_signal:
                process.send_signal(signal.SIGTERM)
            else:
                process.stdin.close()
            assert process.wait(SECONDS) == status
        finally:
            process.kill()


# A file system that does not answer holds the thread that watches the processes.
HUNG_DISK = """
    import sys, time
    from daedalus.cli.commands import train
    from daedalus.learner.serving.events import EventFile
    def hang(self, *_):
        print("reading", flush=True)
        time.sleep(1000)
    EventFile.__init__ = hang
    train._DISK_SECONDS = 0.2
    sys.exit(train.train(["cartpole", "--run-dir", sys.argv[1]]))
"""


def test_launcher_ends_although_the_disk_does_not_answer(tmp_path: Path) -> None:
    command = [sys.executable, "-c", textwrap.dedent(HUNG_DISK), str(tmp_path / "run")]
    with subprocess.Popen(command, stdout=subprocess.PIPE) as launcher:  # the pipe ends with the last process of it
        try:
            assert launcher.stdout is not None
            while launcher.stdout.readline() not in (b"reading\n", b""):
                pass
            launcher.send_signal(signal.SIGTERM)
            assert launcher.wait(SECONDS) == 1
            launcher.stdout.read()
        finally:
            launcher.kill()
