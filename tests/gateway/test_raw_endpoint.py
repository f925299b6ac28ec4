"""Clients at /raw, which run the policy themselves: packets over a WebSocket."""

import contextlib
import json
import ssl
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from gateways import RunningGateway
from processes import LIMIT, until
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import connect

from daedalus.cli.commands.certs import certs
from daedalus.gateway.raw.connection import RawConnection
from daedalus.gateway.raw.packets import GREETING, Kind, Packet, encode_packet, is_own_key
from daedalus.transport.memory import MemoryNetwork, MemoryTransport

HELLO = {"type": "hello", "version": 1, "name": "wing"}


class RawClient:
    """A client of packets."""

    def __init__(self, stack: contextlib.ExitStack, port: int, scheme: str = "ws", **options: Any) -> None:
        address = f"{scheme}://127.0.0.1:{port}/raw"
        self.socket = stack.enter_context(connect(address, open_timeout=LIMIT, max_size=None, **options))
        self._data = b""

    def begin(self, **hello: Any) -> None:
        self.socket.send(json.dumps({**HELLO, **hello}))
        self.socket.send(GREETING)
        assert self.read(4) == GREETING

    def send(self, kind: Kind, number: int, key: str, payload: bytes = b"") -> None:
        timeout = 60.0 if kind == Kind.QUERY else 0.0
        data = encode_packet(Packet(kind, number, key, timeout, payload))
        for first in range(0, len(data), 1 << 18):  # a packet may come in several messages
            self.socket.send(data[first : first + (1 << 18)])

    def read(self, size: int) -> bytes:
        while len(self._data) < size:
            message = self.socket.recv(timeout=LIMIT)
            assert isinstance(message, bytes), message
            self._data += message
        read, self._data = self._data[:size], self._data[size:]
        return read

    def expect(self, packet: Packet) -> None:
        expected = encode_packet(packet)
        assert self.read(len(expected)) == expected


@pytest.fixture
def stack() -> Iterator[contextlib.ExitStack]:
    with contextlib.ExitStack() as opened:
        yield opened


def test_packets_of_any_size_pass_and_presence_ends_with_the_connection(
    network: MemoryNetwork, gateway: RunningGateway, stack: contextlib.ExitStack
) -> None:
    learner = MemoryTransport(network)
    present: dict[str, bool] = {}
    learner.watch_presence("daedalus/r/actors/*/*", present.__setitem__)
    learner.serve("daedalus/r/rollouts/wing", lambda request: request.reply(request.payload[::-1]))
    client = RawClient(stack, gateway.port)
    client.begin()
    payload = bytes(range(256)) * (20 << 10)  # 5 MiB
    client.send(Kind.QUERY, 7, "daedalus/r/rollouts/wing", payload)
    client.expect(Packet(Kind.ANSWER, 7, payload=payload[::-1]))
    client.expect(Packet(Kind.END, 7))
    client.send(Kind.FOLLOW, 8, "daedalus/r/snapshots")
    client.send(Kind.ANNOUNCE, 9, "daedalus/r/actors/wing/1")
    until(lambda: present.get("daedalus/r/actors/wing/1"))
    learner.publish("daedalus/r/snapshots", b"weights")
    client.expect(Packet(Kind.NEWS, 8, "daedalus/r/snapshots", payload=b"weights"))
    client.socket.close()
    until(lambda: present["daedalus/r/actors/wing/1"] is False)


@pytest.mark.parametrize(
    "first", ["", "{", '{"type":"hello","version":1}', '{"type":"hello","version":2,"name":"a"}', b"DBR1"]
)
def test_client_that_does_not_greet_is_told_why(
    gateway: RunningGateway, stack: contextlib.ExitStack, first: str | bytes
) -> None:
    client = RawClient(stack, gateway.port)
    client.socket.send(first)
    assert json.loads(client.socket.recv(timeout=LIMIT))["type"] == "error"
    with pytest.raises(ConnectionClosed):
        client.socket.recv(timeout=LIMIT)


def test_client_for_which_no_thread_can_be_started_may_try_again(
    gateway: RunningGateway, stack: contextlib.ExitStack, monkeypatch: pytest.MonkeyPatch
) -> None:
    start = threading.Thread.start

    def refuse(self: threading.Thread) -> None:
        if self.name == "raw-client":
            raise RuntimeError("can't start new thread")
        start(self)

    with monkeypatch.context() as full:
        full.setattr(threading.Thread, "start", refuse)
        client = RawClient(stack, gateway.port)
        client.socket.send(json.dumps(HELLO))
        error = json.loads(client.socket.recv(timeout=LIMIT))
        assert (error["code"], "too many threads" in error["reason"]) == ("unavailable", True)
        with pytest.raises(ConnectionClosed) as closed:
            client.socket.recv(timeout=LIMIT)
        assert closed.value.rcvd is not None
        assert closed.value.rcvd.code == 1013
    RawClient(stack, gateway.port).begin()


def test_transport_of_a_client_is_closed_on_its_own_thread(
    gateway: RunningGateway, stack: contextlib.ExitStack, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A congested link makes it wait, and the event loop serves all clients."""
    threads: set[str] = set()
    dropped = threading.Event()
    close, drop = MemoryTransport.close, RawConnection.drop
    monkeypatch.setattr(
        MemoryTransport, "close", lambda self: threads.add(threading.current_thread().name) or close(self)
    )
    monkeypatch.setattr(RawConnection, "drop", lambda self, reason: drop(self, reason) or dropped.set())
    client = RawClient(stack, gateway.port)
    client.begin()
    client.send(Kind.QUERY, 1, "daedalus/r/status")
    client.expect(Packet(Kind.END, 1))
    client.socket.close()
    assert dropped.wait(LIMIT), "the event loop has done its part"
    until(lambda: threads)
    assert threads == {"raw-client"}


def test_broken_packet_ends_the_connection_with_the_reason(
    gateway: RunningGateway, stack: contextlib.ExitStack
) -> None:
    client = RawClient(stack, gateway.port)
    client.begin()
    client.send(Kind.QUERY, 1, "other/key")
    client.expect(Packet(Kind.ERROR, 0, payload=b"the key of QUERY is not valid: 'other/key'"))
    with pytest.raises(ConnectionClosed):
        client.socket.recv(timeout=LIMIT)


def test_client_with_a_token_acts_under_its_own_name_only(
    network: MemoryNetwork, stack: contextlib.ExitStack, tmp_path: Path
) -> None:
    made = tmp_path / "certs"
    assert certs(["init", str(made)]) == 0
    assert certs(["issue", "gateway", "--directory", str(made)]) == 0
    assert certs(["issue", "client", "wing", "--directory", str(made)]) == 0
    token = (made / "client-wing" / "token").read_text().strip()
    tls = {"scheme": "wss", "ssl": ssl.create_default_context(cafile=made / "client-wing" / "ca.pem")}
    running = RunningGateway(network, made / "gateway")
    learner = MemoryTransport(network)
    learner.serve("daedalus/r/rollouts/*", lambda request: request.reply(b"accepted"))
    try:
        stranger = RawClient(stack, running.port, **tls)
        stranger.socket.send(json.dumps(HELLO))
        assert "the token is not one of this name" in json.loads(stranger.socket.recv(timeout=LIMIT))["reason"]
        client = RawClient(stack, running.port, **tls)
        client.begin(token=token)
        client.send(Kind.QUERY, 1, "daedalus/r/rollouts/wing.2", b"data")
        client.expect(Packet(Kind.ANSWER, 1, payload=b"accepted"))
        client.expect(Packet(Kind.END, 1))
        client.send(Kind.QUERY, 2, "daedalus/r/rollouts/other", b"data")
        reason = b"this client may act as wing only, not use the key daedalus/r/rollouts/other"
        client.expect(Packet(Kind.ERROR, 0, payload=reason))
    finally:
        running.close()
    assert running.failure is None


@pytest.mark.parametrize(
    ("key", "own"),
    [
        ("daedalus/r/join/wing", True),
        ("daedalus/*/join/wing.2", True),
        ("daedalus/r/join/*", False),
        ("daedalus/r/join/wings", False),
        ("daedalus/r/actors/wing/7", True),
        ("daedalus/r/actors/*/*", False),
        ("daedalus/r/evaluations/other", False),
        ("daedalus/r/reports/wing", True),
        ("daedalus/r/reports/other", False),
        ("daedalus/r/program/*", True),
        ("daedalus/r/snapshots", True),
        ("daedalus/r/end", True),
        ("daedalus/r/learner", True),
        ("daedalus/r/status", False),
        ("daedalus/r/drain/wing", False),
        ("daedalus/r", False),
    ],
)
def test_own_keys(key: str, own: bool) -> None:
    assert is_own_key(key, "wing") is own
