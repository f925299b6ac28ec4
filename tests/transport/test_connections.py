"""Connections: what a listener accepts, how they close, calls that do not return, and pauses between attempts."""

import os
import socket
import struct
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import ExitStack, closing, suppress
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from certificates import make_certificates
from log_lines import LINES
from processes import LIMIT, until
from routers import listen_somewhere

from daedalus.protocol import keys
from daedalus.protocol.limits import JOIN_LIMITS
from daedalus.transport import connecting, zenoh_settings, zenoh_transport
from daedalus.transport import retries as retries_module
from daedalus.transport.credentials import load
from daedalus.transport.interface import Request, UnreachableError
from daedalus.transport.retries import Retries
from daedalus.transport.slow_calls import SlowCall, in_progress
from daedalus.transport.zenoh_session import no_answer
from daedalus.transport.zenoh_settings import Capacity
from daedalus.transport.zenoh_transport import connect, listen

MIB = 1 << 20
NO_ANSWER_SECONDS = 0.5


def test_messages_above_the_limit_are_dropped_and_the_session_goes_on() -> None:
    endpoint, router = listen_somewhere(max_message_bytes=MIB)
    sizes: list[int] = []

    def serve(request: Request) -> None:
        sizes.append(request.size)
        request.reply(b"received")

    with closing(router), closing(connect([endpoint])) as client:
        router.serve("d/r/x", serve)
        assert client.query("d/r/x", bytes(MIB // 2), timeout=LIMIT) == [b"received"]
        assert client.query("d/r/x", bytes(2 * MIB), timeout=NO_ANSWER_SECONDS) == []
        assert client.query("d/r/x", b"", timeout=LIMIT) == [b"received"]
    assert sizes == [MIB // 2, 0]


@pytest.mark.parametrize("key", [keys.join("r", "arm"), keys.reports("r", "arm"), keys.orders("r", "alice")])
def test_small_queries_are_filtered_by_their_size(key: str) -> None:
    """A router does not forward 400 MB to a learner in a request to join."""
    endpoint, router = listen_somewhere()
    with closing(router), closing(connect([endpoint])) as learner, closing(connect([endpoint])) as actor:
        learner.serve(key, lambda request: request.reply(b"welcome"))
        until(lambda: actor.query(key, b"x" * JOIN_LIMITS.message_bytes, timeout=LIMIT) == [b"welcome"])
        assert actor.query(key, b"x" * (JOIN_LIMITS.message_bytes + 1), timeout=NO_ANSWER_SECONDS) == []


def test_silent_connections_keep_nobody_out_and_are_closed(monkeypatch: pytest.MonkeyPatch) -> None:
    """Zenoh alone accepts 100 connections that have not identified themselves, and refuses all others for 10 s."""
    monkeypatch.setattr(zenoh_settings, "_ACCEPT_MILLISECONDS", 500)
    endpoint, router = listen_somewhere()
    host, _, port = endpoint.partition("/")[2].rpartition(":")
    with closing(router), ExitStack() as stack:
        silent = [stack.enter_context(socket.create_connection((host, int(port)))) for _ in range(150)]
        connect([endpoint]).close()
        for each in silent:
            each.settimeout(LIMIT)
            assert each.recv(1) == b""


@pytest.mark.parametrize(
    ("descriptors", "sessions", "pending"), [(1024, 512, 256), (20_000, 10_000, 4096), (10**6, 20_000, 4096)]
)
def test_connections_leave_a_quarter_of_the_descriptors(descriptors: int, sessions: int, pending: int) -> None:
    capacity = Capacity(descriptors=descriptors)
    assert (capacity.sessions, capacity.pending) == (sessions, pending)
    assert 4 * (capacity.sessions + capacity.pending) <= 3 * descriptors


def test_a_full_listener_refuses_further_sessions(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(zenoh_settings, "_MOST_SESSIONS", 2)
    endpoint, router = listen_somewhere()
    with closing(router), ExitStack() as stack:
        router.serve("d/r/x", lambda request: request.reply(b"received"))
        ends = [stack.enter_context(closing(connect([endpoint]))) for _ in range(2)]
        with pytest.raises(Exception, match=endpoint):
            stack.enter_context(closing(connect([endpoint])))
        assert [end.query("d/r/x", timeout=LIMIT) for end in ends] == [[b"received"]] * 2
        ends[0].close()
        began = time.monotonic()
        while time.monotonic() < began + LIMIT:
            try:
                stack.enter_context(closing(connect([endpoint])))
                break
            except Exception:
                time.sleep(0.05)
        else:
            pytest.fail("no session could be opened in the place of a closed one")


PAIR = struct.Struct("ii")


def lingering() -> int:
    """Return the number of sockets of this process whose close() waits for the other end."""
    count = 0
    for entry in os.listdir("/dev/fd"):
        try:
            found = socket.socket(fileno=int(entry))
        except OSError:  # not a socket, or the descriptor of the folder itself
            continue
        with suppress(OSError):  # closed meanwhile
            count += PAIR.unpack(found.getsockopt(socket.SOL_SOCKET, socket.SO_LINGER, PAIR.size))[0]
        found.detach()
    return count


@pytest.mark.parametrize("protocol", ["tcp", "tls"])
def test_both_ends_close_a_connection_without_waiting(address: str, protocol: str, tmp_path: Path) -> None:
    server = client = None
    if protocol == "tls":
        folder, address = make_certificates(tmp_path / "certs"), address.replace("tcp/", "tls/")
        server, client = load(folder / "router", "router"), load(folder / "learner", "learner")
    router = listen([address], credentials=server)
    clients = [connect([address], client)]
    try:
        until(lambda: not lingering())
        clients += [connect([address], client), connect([address], client)]  # after the router's own declarations
        until(lambda: not lingering())
    finally:
        for transport in (*clients, router):
            transport.close()


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


def test_a_host_that_drops_packets_is_named_within_seconds_and_the_timeout_holds(
    released: threading.Event, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Zenoh needs 10 s for each attempt: none of them is waited for."""
    attempts: list[float] = []

    def connect(*_: Any, **__: Any) -> SimpleNamespace:
        attempts.append(time.monotonic())
        assert released.wait(LIMIT)
        return SimpleNamespace(close=lambda: None)

    monkeypatch.setattr(connecting, "connect", connect)
    monkeypatch.setattr(connecting, "_SILENT_SECONDS", 0.0)
    monkeypatch.setattr(connecting, "_QUIET_SECONDS", 0.0)
    where = ["tcp/10.0.0.1:7447", "tcp/10.0.0.2:7447"]
    with pytest.raises(UnreachableError, match=rf"no answer from {' or '.join(where)}: .* firewall .*tried for 1 s"):
        connecting.connect_with_retry(where, threading.Event(), 1.0)
    assert [line for line in LINES if "no answer" in line] == [f"{no_answer(where)}; waiting for it"]
    with pytest.raises(UnreachableError, match=r"no answer from .*tried for 0\.1 s"):
        connecting.connect_once(where, timeout=0.1)
    monkeypatch.setattr(connecting, "_ONCE_SECONDS", 0.2)
    with pytest.raises(UnreachableError, match=r"tried for 0\.2 s"):
        connecting.connect_once(where)
    assert len(attempts) == 3


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


class Stop(threading.Event):
    """An event that notes how long it is waited for, and lets the clock of the module pass."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        super().__init__()
        self.now, self.pauses = 1000.0, list[float]()
        monkeypatch.setattr(retries_module.time, "monotonic", lambda: self.now)

    def wait(self, timeout: float | None = None) -> bool:
        assert timeout is not None
        self.pauses.append(timeout)
        self.now += timeout
        return self.is_set()


def test_pauses_grow_to_a_bound_and_differ_between_actors(monkeypatch: pytest.MonkeyPatch) -> None:
    stop = Stop(monkeypatch)
    retries = Retries(stop)
    assert not any(retries.wait("two runs") for _ in range(20))
    for pause, longest in zip(stop.pauses, [1.0, 2.0, 4.0, 8.0, 16.0, *[30.0] * 15], strict=True):
        assert longest / 2 <= pause <= longest
    assert len(set(stop.pauses)) == 20
    retries.succeeded()
    retries.wait("two runs")
    assert stop.pauses[-1] <= 1.0
    retries.wait("two runs")
    stop.now += 61.0  # it took part for so long
    retries.wait("two runs")
    assert stop.pauses[-1] <= 1.0
    stop.set()
    assert retries.wait("two runs")


def test_a_cause_is_logged_once_then_at_growing_intervals_and_when_it_changes(monkeypatch: pytest.MonkeyPatch) -> None:
    stop = Stop(monkeypatch)
    retries = Retries(stop)
    while stop.now < 1000.0 + 10 * 3600.0:
        retries.wait("no module x")
    lines = [line for line in LINES if line.startswith("no module x")]
    assert lines[0] == "no module x; trying again, at most every 30 s"
    assert 10 <= len(lines) <= 18  # after 1, 3, 7, 15, 31 and 63 minutes, then each hour
    assert lines[1].endswith("attempts have failed so far")
    retries.wait("two runs")
    assert LINES[-1].startswith("two runs; trying again")
