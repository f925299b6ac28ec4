"""exit_on_thread_exceptions: a fault in any thread ends the process, even while Zenoh holds callbacks."""

import re
import subprocess
import sys
import textwrap

import pytest

SECONDS = 60.0  # generous for slow machines; an idle process would never end

THREAD = """
    threading.Thread(target=fail).start()
"""
ZENOH_HANDLER = """
    router.serve("d/r/join", fail)
    router.query_async("d/r/join", b"", timeout=30.0, on_answer=print)
"""
ZENOH_ANSWER = """
    router.serve("d/r/join", lambda request: request.reply(b""))
    router.query_async("d/r/join", b"", timeout=30.0, on_answer=fail)
"""
ZENOH_PRESENCE = """
    router.watch_presence("d/r/learner", fail)
    router.declare_presence("d/r/learner")
"""
PROGRAM = """
    import socket, threading, time
    from daedalus.launch.logs import configure_logging
    from daedalus.launch.process_lifecycle import exit_on_thread_exceptions
    from daedalus.transport.zenoh_transport import listen

    def fail(*arguments):
        raise RuntimeError("a fault of ours")

    exit_on_thread_exceptions()
    configure_logging()
    router = listen(["tcp/127.0.0.1:0"])
    router.watch_presence("d/r/actors/*", print)
"""


@pytest.mark.parametrize(
    "cause",
    [THREAD, ZENOH_HANDLER, ZENOH_ANSWER, ZENOH_PRESENCE],
    ids=["thread", "handler", "answer", "presence"],
)
def test_exception_in_a_thread_ends_the_process_with_a_traceback(cause: str) -> None:
    program = textwrap.dedent(PROGRAM) + textwrap.dedent(cause) + "time.sleep(1000)\n"
    ended = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=SECONDS)
    assert ended.returncode == 1
    assert "Traceback" in ended.stderr
    assert "in fail" in ended.stderr
    assert ended.stderr.rstrip().endswith("RuntimeError: a fault of ours")
    assert re.search("exception in thread .*: RuntimeError", ended.stdout)


def test_exception_ends_a_process_whose_output_nobody_reads() -> None:
    program = """
        import os, threading, time
        from daedalus.launch import process_lifecycle

        process_lifecycle._TRACEBACK_SECONDS = 0.2
        process_lifecycle.exit_on_thread_exceptions()
        os.set_blocking(2, False)
        try:
            while True:
                os.write(2, bytes(1))
        except BlockingIOError:
            os.set_blocking(2, True)
        threading.Thread(target=lambda: 1 / 0).start()
        time.sleep(1000)
    """
    with subprocess.Popen([sys.executable, "-c", textwrap.dedent(program)], stderr=subprocess.PIPE) as process:
        try:
            assert process.wait(SECONDS) == 1
        finally:
            process.kill()
