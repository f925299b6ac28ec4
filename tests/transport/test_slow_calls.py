"""Calls of Zenoh that do not return, as with a router whose host hangs: nobody waits for them longer than allowed."""

import subprocess
import sys
import threading
from collections.abc import Iterator
from types import SimpleNamespace
from typing import Any

import pytest
from processes import LIMIT, until

from daedalus.transport import connecting, zenoh_transport
from daedalus.transport.slow_calls import SlowCall, in_progress


@pytest.fixture
def released() -> Iterator[threading.Event]:
    """Event until which a call does not return."""
    event = threading.Event()
    yield event
    event.set()
    until(lambda: not in_progress())


def test_result_and_error_of_a_call_are_those_of_the_wait() -> None:
    assert SlowCall(lambda: 7).wait(lambda: None) == 7
    with pytest.raises(ZeroDivisionError):
        SlowCall(lambda: 1 / 0).wait(lambda: None)


def test_stop_ends_an_attempt_to_connect_and_a_late_transport_is_closed(
    released: threading.Event, monkeypatch: pytest.MonkeyPatch
) -> None:
    stop, closed = threading.Event(), threading.Event()

    def connect(*_: Any, **__: Any) -> SimpleNamespace:
        stop.set()
        assert released.wait(LIMIT)
        return SimpleNamespace(close=closed.set)

    monkeypatch.setattr(connecting, "connect", connect)
    assert connecting.connect_with_retry(["tcp/127.0.0.1:1"], stop) is None
    assert not closed.is_set()
    released.set()
    assert closed.wait(LIMIT)


def test_transport_whose_session_does_not_close_is_given_up(
    address: str, released: threading.Event, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(zenoh_transport, "_CLOSE_SECONDS", 0.1)
    transport = zenoh_transport.listen([address])
    assert isinstance(transport, zenoh_transport.ZenohTransport)
    session = transport._session
    monkeypatch.setattr(
        transport, "_session", SimpleNamespace(is_closed=lambda: False, close=lambda: released.wait(LIMIT))
    )
    transport.close()
    assert in_progress()
    session.close()


PROGRAM = """
import sys, threading
from daedalus.launch.process_lifecycle import exit_status
from daedalus.transport.slow_calls import SlowCall

def command():
    SlowCall(threading.Event().wait)
    print("done")
    return 7

sys.exit(exit_status(command))
"""


def test_command_ends_although_a_call_is_in_progress() -> None:
    ended = subprocess.run([sys.executable, "-c", PROGRAM], capture_output=True, text=True, timeout=LIMIT, check=False)
    assert (ended.returncode, ended.stdout) == (7, "done\n")
