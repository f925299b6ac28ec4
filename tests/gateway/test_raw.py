"""Packets of raw clients over MemoryTransport: answers, news, presence, limits and cleanup of its clients."""

import contextlib
import logging
import socket
import struct
import threading
from collections.abc import Callable, Iterator
from typing import Any, ClassVar

import pytest
from log_lines import LINES
from processes import LIMIT, until

from daedalus.gateway.raw import budget, clients, packet_socket
from daedalus.gateway.raw.clients import ClientTable
from daedalus.gateway.raw.connection import RawConnection
from daedalus.gateway.raw.packet_socket import PacketSocket
from daedalus.gateway.raw.packets import GREETING, HEADER_BYTES, MAX_QUERY_BYTES, Kind, Packet, encode_packet
from daedalus.gateway.raw.thread_errors import thread_errors
from daedalus.transport.interface import Request, Transport, TransportError
from daedalus.transport.memory import MemoryNetwork, MemoryTransport

HEADER = struct.Struct("<IBBHI")  # written out again, independent of the code


class Caller:
    """A client, as it would be written in another language."""

    def __init__(self, port: int) -> None:
        self.socket = socket.create_connection(("127.0.0.1", port), LIMIT)
        self.socket.sendall(GREETING)
        assert self.read(4) == b"DBR1"

    def send(self, kind: int, number: int, key: str, payload: bytes = b"", milliseconds: int = 60_000) -> None:
        milliseconds = milliseconds if kind == Kind.QUERY else 0
        head = HEADER.pack(len(payload), kind, len(key), milliseconds, number)
        self.socket.sendall(head + key.encode() + payload)

    def read(self, size: int) -> bytes:
        data = b""
        while len(data) < size and (chunk := self.socket.recv(size - len(data))):
            data += chunk
        return data

    def next(self) -> tuple[int, int, str, bytes]:
        """Return kind, number, key and payload of the next packet."""
        payload, kind, key, milliseconds, number = HEADER.unpack(self.read(HEADER_BYTES))
        assert milliseconds == 0
        return kind, number, self.read(key).decode(), self.read(payload)

    def ended(self) -> bool:
        """Return whether the gateway closed the connection, after reading the packets before."""
        try:
            return self.socket.recv(1) == b""
        except ConnectionError:
            return True


class Scene:
    """Connections of raw clients over TCP, and another transport on their network."""

    def __init__(self) -> None:
        self.network = MemoryNetwork()
        self.end = MemoryTransport(self.network)
        self.open: Callable[[], Transport] = lambda: MemoryTransport(self.network)
        self._listener = socket.create_server(("127.0.0.1", 0))
        self.port = self._listener.getsockname()[1]
        self.table = ClientTable()
        self._clients: list[tuple[RawConnection, threading.Thread]] = []
        self._accepting = threading.Thread(target=self._accept, daemon=True)
        self._accepting.start()
        self.callers: list[Caller] = []

    def _accept(self) -> None:
        with contextlib.suppress(OSError):  # the listener was shut down
            while True:
                connection, _ = self._listener.accept()
                client = RawConnection(connection, lambda: self.open(), self.table)
                self.table.connect(client)
                thread = threading.Thread(target=self._run, args=(client,), daemon=True)
                self._clients.append((client, thread))
                thread.start()

    def _run(self, client: RawConnection) -> None:
        logging.getLogger("daedalus.raw").warning("disconnected: %s", client.run())

    def call(self) -> Caller:
        self.callers.append(Caller(self.port))
        return self.callers[-1]

    def stop(self) -> None:
        for client, thread in self._clients:
            client.close()
            thread.join(LIMIT)
            assert not thread.is_alive()

    def close(self) -> None:
        self._listener.shutdown(socket.SHUT_RDWR)
        self._accepting.join(LIMIT)
        self._listener.close()
        self.stop()
        for caller in self.callers:
            caller.socket.close()


@pytest.fixture
def scene() -> Iterator[Scene]:
    one = Scene()
    yield one
    one.close()


def test_query_receives_every_answer_and_an_end(scene: Scene) -> None:
    other = MemoryTransport(scene.network)
    scene.end.serve("daedalus/a/join", lambda request: request.reply(b"a:" + request.payload))
    other.serve("daedalus/b/join", lambda request: request.reply(b"b:" + request.payload))
    caller = scene.call()
    caller.send(Kind.QUERY, 7, "daedalus/*/join", b"hello")
    answers = {caller.next(), caller.next()}
    assert answers == {(Kind.ANSWER, 7, "", b"a:hello"), (Kind.ANSWER, 7, "", b"b:hello")}
    assert caller.next() == (Kind.END, 7, "", b"")


def test_query_without_servers_ends_without_answers(scene: Scene) -> None:
    caller = scene.call()
    caller.send(Kind.QUERY, 3, "daedalus/r/status")
    assert caller.next() == (Kind.END, 3, "", b"")


def test_queries_run_concurrently(scene: Scene) -> None:
    held = []
    scene.end.serve("daedalus/r/rollouts/*", held.append)
    scene.end.serve("daedalus/r/status", lambda request: request.reply(b"well"))
    caller = scene.call()
    caller.send(Kind.QUERY, 1, "daedalus/r/rollouts/wing", b"slow")
    until(lambda: held)
    caller.send(Kind.QUERY, 2, "daedalus/r/status")
    assert caller.next() == (Kind.ANSWER, 2, "", b"well")
    assert caller.next() == (Kind.END, 2, "", b"")
    held.pop().reply(b"accepted")
    assert caller.next() == (Kind.ANSWER, 1, "", b"accepted")


def test_value_of_a_followed_key_arrives_as_news(scene: Scene) -> None:
    caller = scene.call()
    caller.send(Kind.FOLLOW, 4, "daedalus/r/snapshots")
    caller.send(Kind.QUERY, 5, "daedalus/r/status")
    assert caller.next()[0] == Kind.END  # so the packet before was performed
    scene.end.publish("daedalus/r/snapshots", b"weights")
    assert caller.next() == (Kind.NEWS, 4, "daedalus/r/snapshots", b"weights")


def test_slow_client_receives_only_the_newest_value(scene: Scene) -> None:
    caller = scene.call()
    caller.send(Kind.FOLLOW, 4, "daedalus/r/snapshots")
    caller.send(Kind.QUERY, 5, "daedalus/r/status")
    assert caller.next()[0] == Kind.END
    value = bytes(4 << 20)  # more than the sockets hold
    for _ in range(30):
        scene.end.publish("daedalus/r/snapshots", value)
    scene.end.publish("daedalus/r/snapshots", b"the last")
    came = 0
    while caller.next()[3] != b"the last":
        came += 1
    assert came < 30


def test_presence_is_reported_and_ends_with_the_client(scene: Scene) -> None:
    present: dict[str, bool] = {}
    scene.end.watch_presence("daedalus/r/actors/*", present.__setitem__)
    scene.end.declare_presence("daedalus/r/learner")
    caller = scene.call()
    caller.send(Kind.WATCH, 1, "daedalus/r/learner")
    assert caller.next() == (Kind.PRESENT, 1, "daedalus/r/learner", b"")
    caller.send(Kind.ANNOUNCE, 2, "daedalus/r/actors/wing")
    until(lambda: present.get("daedalus/r/actors/wing"))
    scene.end.close()
    assert caller.next() == (Kind.ABSENT, 1, "daedalus/r/learner", b"")
    watcher = MemoryTransport(scene.network)
    watcher.watch_presence("daedalus/r/actors/*", present.__setitem__)
    caller.socket.close()
    until(lambda: present.get("daedalus/r/actors/wing") is False)
    until(lambda: len(scene.network.ends) == 1)


def test_presence_keys_that_no_packet_can_hold_are_ignored(scene: Scene) -> None:
    caller = scene.call()
    caller.send(Kind.WATCH, 1, "daedalus/r/actors/*")
    for name in ("\N{LATIN SMALL LETTER E WITH ACUTE}", "x" * 300, "wing"):
        scene.end.declare_presence(f"daedalus/r/actors/{name}")
    assert caller.next() == (Kind.PRESENT, 1, "daedalus/r/actors/wing", b"")


@pytest.mark.parametrize(
    ("packet", "complaint"),
    [
        (HEADER.pack(0, 9, 0, 0, 1), "kind 9"),
        (HEADER.pack(MAX_QUERY_BYTES + 1, Kind.QUERY, 16, 0, 1), "the limit is"),
        (HEADER.pack(1, Kind.FOLLOW, 16, 0, 1), "the limit is 0"),
        (HEADER.pack(0, Kind.QUERY, 4, 0, 1) + b"@/**", "is not valid"),
        (HEADER.pack(0, Kind.QUERY, 0, 0, 1), "is not valid"),
        (HEADER.pack(0, Kind.QUERY, 11, 0, 1) + b"daedalus/**", "is not valid"),
        (HEADER.pack(0, Kind.QUERY, 10, 0, 1) + b"daedalus/\xff", "is not valid"),
        (HEADER.pack(0, Kind.FOLLOW, 10, 0, 1) + b"daedalus/*", "is not valid"),
    ],
    ids=str,
)
def test_invalid_packet_ends_the_connection_with_an_error(scene: Scene, packet: bytes, complaint: str) -> None:
    caller = scene.call()
    caller.socket.sendall(packet)
    kind, _, _, reason = caller.next()
    assert kind == Kind.ERROR
    assert complaint in reason.decode()
    assert caller.ended()
    until(lambda: len(scene.network.ends) == 1)


def test_client_without_greeting_is_disconnected(scene: Scene) -> None:
    with socket.create_connection(("127.0.0.1", scene.port), LIMIT) as stranger:
        stranger.sendall(b"GET / HTTP/1.1\r\n\r\n")
        assert stranger.recv(4) == GREETING
        with contextlib.suppress(ConnectionError):  # it is closed with bytes unread
            while stranger.recv(64):
                pass
    until(lambda: any("uses another protocol" in line for line in LINES))


def test_client_that_stalls_within_a_packet_is_disconnected(scene: Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(packet_socket, "STALL_SECONDS", 0.1)
    caller = scene.call()
    caller.send(Kind.QUERY, 1, "daedalus/r/status")
    assert caller.next()[0] == Kind.END
    threading.Event().wait(0.3)  # silence between two packets is allowed
    caller.send(Kind.QUERY, 2, "daedalus/r/status")
    assert caller.next()[0] == Kind.END
    caller.socket.sendall(HEADER.pack(1000, Kind.QUERY, 17, 0, 1))
    kind, _, _, reason = caller.next()
    assert (kind, b"sent nothing" in reason) == (Kind.ERROR, True)
    assert caller.ended()


def test_each_part_of_a_large_answer_has_a_time_limit_of_its_own() -> None:
    """`sendall` has one time limit for all that it is given, however steadily the client reads."""

    class Recorder(socket.socket):
        """A socket that only records what it sends."""

        parts: ClassVar[list[bytes]] = []

        def sendall(self, data: Any, flags: int = 0) -> None:
            self.parts.append(bytes(data))

    packet = Packet(Kind.ANSWER, 1, payload=bytes(range(256)) * 1000)
    with Recorder() as connection:
        PacketSocket(connection).send(packet)
    assert b"".join(Recorder.parts) == encode_packet(packet)
    assert max(map(len, Recorder.parts)) == 64 << 10


def test_queries_beyond_the_budget_wait_in_the_connection(scene: Scene) -> None:
    held = []
    scene.end.serve("daedalus/r/rollouts/*", held.append)
    caller = scene.call()
    for number in range(80):
        caller.send(Kind.QUERY, number, "daedalus/r/rollouts/wing", b"x")
    until(lambda: len(held) == 64)
    assert not threading.Event().wait(0.2)
    assert len(held) == 64
    for _ in range(80):
        until(lambda: held)
        held.pop().reply(b"accepted")
        assert caller.next()[0] == Kind.ANSWER
        assert caller.next()[0] == Kind.END


def test_disconnection_is_noticed_while_the_budget_is_full(scene: Scene) -> None:
    held = []
    scene.end.serve("daedalus/r/rollouts/*", held.append)
    caller = scene.call()
    for number in range(80):
        caller.send(Kind.QUERY, number, "daedalus/r/rollouts/wing", b"x")
    until(lambda: len(held) == 64)
    caller.socket.close()
    until(lambda: len(scene.network.ends) == 1)
    held.clear()


def test_client_that_takes_all_queries_leaves_others_their_own(scene: Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(budget, "_OWN_QUERIES", 2)
    monkeypatch.setattr(budget, "_SHARED_QUERIES", 3)
    held: list[Request] = []
    scene.end.serve("daedalus/r/rollouts/*", held.append)

    def of(name: str) -> list[Request]:
        return [request for request in list(held) if request.key.endswith(name)]

    greedy, other = scene.call(), scene.call()
    for number in range(9):
        greedy.send(Kind.QUERY, number, "daedalus/r/rollouts/greedy")
    until(lambda: len(of("greedy")) == 5)
    for number in range(3):
        other.send(Kind.QUERY, number, "daedalus/r/rollouts/other")
    until(lambda: len(of("other")) == 2)
    assert not threading.Event().wait(0.2)
    assert (len(of("greedy")), len(of("other"))) == (5, 2)
    greedy.socket.close()
    until(lambda: len(scene.network.ends) == 2)
    for request in of("greedy"):
        request.reply(b"late")  # their threads end
    until(lambda: len(of("other")) == 3)
    for request in of("other"):
        request.reply(b"accepted")
    assert sorted(other.next()[0] for _ in range(6)) == [Kind.ANSWER] * 3 + [Kind.END] * 3
    until(lambda: scene.table.queries.taken == 0)


@pytest.mark.parametrize("thread", ["raw-query", "raw-news"])
def test_client_for_which_no_thread_can_be_started_is_disconnected(
    scene: Scene, monkeypatch: pytest.MonkeyPatch, thread: str
) -> None:
    start = threading.Thread.start

    def refuse(self: threading.Thread) -> None:
        if self.name == thread:
            raise RuntimeError("can't start new thread")
        start(self)

    with monkeypatch.context() as full:
        full.setattr(threading.Thread, "start", refuse)
        caller = scene.call()
        caller.send(Kind.QUERY, 1, "daedalus/r/status")
        assert caller.next() == (Kind.ERROR, 0, "", b"the gateway has too many threads: try again later")
        assert caller.ended()
        until(lambda: len(scene.network.ends) == 1)
    use(scene, scene.call())


def test_other_errors_at_the_start_of_a_thread_are_ours() -> None:
    with pytest.raises(RuntimeError, match="a fault of ours"), thread_errors():
        raise RuntimeError("a fault of ours")


def test_number_of_followed_keys_is_limited(scene: Scene) -> None:
    caller = scene.call()
    for number in range(9):
        caller.send(Kind.FOLLOW, number, "daedalus/r/snapshots")
    kind, _, _, reason = caller.next()
    assert (kind, b"more than 8 keys" in reason) == (Kind.ERROR, True)


def test_number_of_declarations_is_limited(scene: Scene) -> None:
    caller = scene.call()
    for number in range(65):
        caller.send(Kind.ANNOUNCE, number, f"daedalus/r/actors/wing-{number}")
    kind, _, _, reason = caller.next()
    assert (kind, b"more than 64 keys" in reason) == (Kind.ERROR, True)


def test_unreachable_network_is_reported_to_the_client(scene: Scene) -> None:
    def unreachable() -> Transport:
        raise TransportError("nothing answers at tcp/127.0.0.1:1")

    scene.open = unreachable
    caller = scene.call()
    caller.send(Kind.QUERY, 1, "daedalus/r/status")
    assert caller.next() == (Kind.ERROR, 0, "", b"nothing answers at tcp/127.0.0.1:1")
    assert caller.ended()


# ------------------------------------------------------------------------------------ places and memory


def use(scene: Scene, caller: Caller) -> None:
    """Send a query and read its end, so that the table counts the caller as a client."""
    caller.send(Kind.QUERY, 1, "daedalus/r/status")
    assert caller.next()[0] == Kind.END


def test_clients_beyond_the_limit_are_refused(scene: Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(clients, "MAX_RAW_CLIENTS", 1)
    first, late = scene.call(), scene.call()
    use(scene, first)
    late.send(Kind.QUERY, 1, "daedalus/r/status")
    kind, _, _, reason = late.next()
    assert (kind, b"clients are connected already" in reason) == (Kind.ERROR, True)
    assert late.ended()
    use(scene, first)


def test_new_client_takes_the_place_of_the_longest_silent_one(scene: Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(clients, "MAX_RAW_CLIENTS", 2)
    monkeypatch.setattr(clients, "IDLE_SECONDS", 0.0)
    silent, busy, new = scene.call(), scene.call(), scene.call()
    for caller in (silent, busy, new):
        use(scene, caller)
    assert silent.ended()
    use(scene, busy)
    until(lambda: any("and a new client needs its place" in line for line in LINES))


@pytest.mark.parametrize("greeting", [b"", GREETING], ids=["silent", "greeted"])
def test_connections_without_a_packet_take_no_place(
    scene: Scene, monkeypatch: pytest.MonkeyPatch, greeting: bytes
) -> None:
    monkeypatch.setattr(clients, "MAX_RAW_CLIENTS", 1)
    monkeypatch.setattr(clients, "_MAX_NEW_CONNECTIONS", 4)
    with contextlib.ExitStack() as stack:
        address = ("127.0.0.1", scene.port)
        silent = [stack.enter_context(socket.create_connection(address, LIMIT)) for _ in range(20)]
        for connection in silent:
            with contextlib.suppress(ConnectionError):  # the oldest are disconnected already
                connection.sendall(greeting)
        use(scene, scene.call())
        assert len(scene.network.ends) == 2  # no session for the silent ones
        with contextlib.suppress(ConnectionError):
            assert silent[0].recv(8) in (b"", GREETING)
            assert silent[0].recv(8) == b""
        until(lambda: any("newer connections wait" in line for line in LINES))


def test_client_that_sends_no_packet_is_disconnected(scene: Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(packet_socket, "HANDSHAKE_SECONDS", 0.1)
    caller = scene.call()
    kind, _, _, reason = caller.next()
    assert (kind, b"sent no packet within 0.1 s" in reason) == (Kind.ERROR, True)
    assert caller.ended()


def test_client_that_sends_a_packet_byte_by_byte_is_disconnected(scene: Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(packet_socket, "STALL_SECONDS", 0.3)
    caller = scene.call()
    use(scene, caller)
    with contextlib.suppress(ConnectionError):
        for byte in HEADER.pack(0, Kind.QUERY, 100, 0, 1) + b"daedalus/" + b"x" * 1000:
            caller.socket.sendall(bytes([byte]))
            threading.Event().wait(0.02)
    until(lambda: any("within a packet" in line for line in LINES))


def test_client_that_leaves_answers_unread_is_dropped(scene: Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(clients, "CLIENT_BYTES", 8 << 20)
    value = bytes(8 << 20)  # more than the sockets hold
    scene.end.serve("daedalus/r/snapshots", lambda request: request.reply(value))
    reader, caller = scene.call(), scene.call()
    for number in range(4):
        caller.send(Kind.QUERY, number, "daedalus/r/snapshots")
    until(lambda: any("bytes of its queries and unread answers wait" in line for line in LINES))
    until(lambda: len(scene.network.ends) == 1)  # its session ended; the reader sent no packet yet
    reader.send(Kind.QUERY, 1, "daedalus/r/snapshots")  # one answer of any size fits
    assert reader.next() == (Kind.ANSWER, 1, "", value)
    assert reader.next()[0] == Kind.END


def test_client_with_the_largest_share_is_dropped_when_all_hold_too_much(
    scene: Scene, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(clients, "TOTAL_BYTES", 20 << 20)
    scene.end.serve("daedalus/r/snapshots", lambda request: request.reply(bytes(8 << 20)))
    small, large = scene.call(), scene.call()
    small.send(Kind.QUERY, 1, "daedalus/r/snapshots")
    assert small.read(1)  # the answer is on its way
    for number in range(4):
        large.send(Kind.QUERY, number, "daedalus/r/snapshots")
    until(lambda: any("bytes of queries and answers wait in the gateway" in line for line in LINES))
    until(lambda: len(scene.network.ends) == 2)
    assert len(small.read(HEADER_BYTES - 1 + (8 << 20))) == HEADER_BYTES - 1 + (8 << 20)
    assert small.next()[0] == Kind.END


def test_queries_in_transfer_count_before_their_memory_is_allocated(
    scene: Scene, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(clients, "TOTAL_BYTES", MAX_QUERY_BYTES)
    callers = [scene.call() for _ in range(3)]
    key = b"daedalus/r/status"
    for caller in callers:
        use(scene, caller)
        caller.socket.sendall(HEADER.pack(MAX_QUERY_BYTES, Kind.QUERY, len(key), 0, 1) + key)
    until(lambda: any("bytes of queries and answers wait in the gateway" in line for line in LINES))
    until(lambda: len(scene.network.ends) == 3)  # two callers and the scene's own


def test_news_waits_in_the_transport_until_the_client_reads(scene: Scene) -> None:
    caller = scene.call()
    for number in range(8):
        caller.send(Kind.FOLLOW, number, "daedalus/r/snapshots")
    use(scene, caller)
    value = bytes(8 << 20)
    scene.end.publish("daedalus/r/snapshots", value)
    assert caller.read(1)
    transport = next(end for end in scene.network.ends if end is not scene.end)
    assert sum(inbox.newest is not None for inbox in transport._inboxes) == 7


def test_stop_disconnects_clients_and_ends_their_presence(scene: Scene) -> None:
    caller = scene.call()
    caller.send(Kind.ANNOUNCE, 1, "daedalus/r/actors/wing")
    until(lambda: len(scene.network.ends) == 2)
    scene.stop()
    assert caller.ended()
    until(lambda: len(scene.network.ends) == 1)


def test_bytes_of_a_packet() -> None:
    packet = Packet(Kind.QUERY, 258, "daedalus/r/join", timeout=5.0, payload=b"abc")
    assert encode_packet(packet) == bytes.fromhex("03000000 01 0f 8813 02010000") + b"daedalus/r/joinabc"
