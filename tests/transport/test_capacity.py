"""What a listener accepts from its peers: sizes of messages, and connections that say nothing."""

import socket
import time
from contextlib import ExitStack, closing

import pytest
from processes import LIMIT, free_address, until

from daedalus.protocol import keys
from daedalus.protocol.limits import JOIN_LIMITS
from daedalus.transport import zenoh_settings
from daedalus.transport.interface import AddressInUseError, Request, Transport
from daedalus.transport.zenoh_settings import MAX_MESSAGE_BYTES, Capacity
from daedalus.transport.zenoh_transport import connect, listen

MIB = 1 << 20
NO_ANSWER_SECONDS = 2.0


def listen_somewhere(max_message_bytes: int = MAX_MESSAGE_BYTES) -> tuple[str, Transport]:
    while True:
        endpoint = free_address()
        try:
            return endpoint, listen([endpoint], max_message_bytes=max_message_bytes)
        except AddressInUseError:
            continue


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


@pytest.mark.parametrize("key", [keys.join("r", "arm"), keys.reports("r", "arm"), keys.orders("r")])
def test_small_queries_are_filtered_by_their_size(key: str) -> None:
    """A router does not forward 400 MB to a learner in a request to join."""
    endpoint, router = listen_somewhere()
    with closing(router), closing(connect([endpoint])) as learner, closing(connect([endpoint])) as actor:
        learner.serve(key, lambda request: request.reply(b"welcome"))
        until(lambda: actor.query(key, b"x" * JOIN_LIMITS.message_bytes, timeout=LIMIT) == [b"welcome"])
        assert actor.query(key, b"x" * (JOIN_LIMITS.message_bytes + 1), timeout=NO_ANSWER_SECONDS) == []


def test_silent_connections_keep_nobody_out_and_are_closed(monkeypatch: pytest.MonkeyPatch) -> None:
    """Zenoh alone accepts 100 connections that have not identified themselves, and refuses all others for 10 s."""
    monkeypatch.setattr(zenoh_settings, "_ACCEPT_MILLISECONDS", 2000)
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
