"""SIGTERM ends a process whose main thread runs native code, in which Python calls no signal handler."""

import signal
import subprocess
import sys
import textwrap

import pytest

SECONDS = 60.0  # generous for slow machines; a process that ignores the signal would never end

PREAMBLE = """
    import os, sys, threading
    from daedalus.cli import processes
    stop = processes.stop_on_signals()
"""
# A second lock of the same mutex never returns, and releases the interpreter's lock while it waits.
STUCK = """
    import ctypes
    processes._STUCK_SECONDS = 0.2
    processes.exit_if_stuck(stop)
    libc, mutex = ctypes.CDLL(None), ctypes.create_string_buffer(128)
    print("ready", flush=True)
    while True:
        libc.pthread_mutex_lock(mutex)
"""
SEEN_BY_A_THREAD = """
    import ctypes
    threading.Thread(target=lambda: (stop.wait(), os._exit(7))).start()
    libc, mutex = ctypes.CDLL(None), ctypes.create_string_buffer(128)
    print("ready", flush=True)
    while True:
        libc.pthread_mutex_lock(mutex)
"""
CHILD = """
    import signal, time
    child = os.fork()
    if child == 0:
        time.sleep(1000)
    time.sleep(0.2)
    os.kill(child, signal.SIGTERM)
    time.sleep(0.2)
    os.kill(child, signal.SIGKILL)
    os.waitpid(child, 0)
    print("ready" if not stop.wait(0.1) else "stopped by the signal of its child", flush=True)
    stop.wait()
"""


@pytest.mark.parametrize(
    ("program", "status"), [(STUCK, 1), (SEEN_BY_A_THREAD, 7), (CHILD, 0)], ids=["stuck", "seen by a thread", "child"]
)
def test_signal_is_seen_in_native_code_and_only_by_its_process(program: str, status: int) -> None:
    command = [sys.executable, "-c", textwrap.dedent(PREAMBLE) + textwrap.dedent(program)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        try:
            assert process.stdout is not None
            assert process.stdout.readline() == "ready\n"
            process.send_signal(signal.SIGTERM)
            assert process.wait(SECONDS) == status
        finally:
            process.kill()
