"""`daedalus bridge` as a process, on a real network."""

import socket
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from certificates import make_certificates
from processes import LIMIT, Running, until

from daedalus.bridge.packets import GREETING, Kind, Packet, encode_packet
from daedalus.transport.credentials import load
from daedalus.transport.interface import Transport
from daedalus.transport.zenoh_transport import listen

Start = Callable[..., Running]


@pytest.fixture
def router(address: str) -> Iterator[Transport]:
    one = listen([address])
    yield one
    one.close()


def client_of(bridge: Running) -> socket.socket:
    port = bridge.expect(r"clients connect to tcp/127.0.0.1:(\d+)")[1]
    return socket.create_connection(("127.0.0.1", int(port)), LIMIT)


def test_stop_during_a_query_ends_the_bridge_and_its_presence(start: Start, address: str, router: Transport) -> None:
    present: dict[str, bool] = {}
    held = []
    router.watch_presence("daedalus/r/actors/*/*", present.__setitem__)
    router.serve("daedalus/r/status", held.append)
    bridge = start("bridge", "--connect", address, "--listen", "tcp/127.0.0.1:0")
    with client_of(bridge) as client:
        client.sendall(GREETING + encode_packet(Packet(Kind.ANNOUNCE, 1, "daedalus/r/actors/wing/7")))
        client.sendall(encode_packet(Packet(Kind.QUERY, 2, "daedalus/r/status", timeout=60.0)))
        until(lambda: held and present.get("daedalus/r/actors/wing/7"))
        bridge.process.terminate()
        assert bridge.wait() == 0, bridge.output
        until(lambda: present["daedalus/r/actors/wing/7"] is False)


def test_presence_of_a_killed_client_ends(start: Start, address: str, router: Transport) -> None:
    present: dict[str, bool] = {}
    router.watch_presence("daedalus/r/actors/*/*", present.__setitem__)
    bridge = start("bridge", "--connect", address, "--listen", "tcp/127.0.0.1:0")
    with client_of(bridge) as client:
        client.sendall(GREETING + encode_packet(Packet(Kind.ANNOUNCE, 1, "daedalus/r/actors/wing/7")))
        until(lambda: present.get("daedalus/r/actors/wing/7"))
    until(lambda: present["daedalus/r/actors/wing/7"] is False)
    bridge.expect(" disconnected$")


@pytest.mark.parametrize(
    ("arguments", "complaint"),
    [
        (("--listen", "localhost"), "not an address"),
        (("--listen", "tls/127.0.0.1:0"), "use no TLS"),
        (("--listen", "tcp/0.0.0.0:0"), "is unencrypted and open to every host"),
        (("--connect", "tls/127.0.0.1:1"), "needs certificates: --tls DIR"),
    ],
    ids=str,
)
def test_bad_usage_is_reported(start: Start, arguments: tuple[str, ...], complaint: str) -> None:
    bridge = start("bridge", *(() if "--connect" in arguments else ("--connect", "tcp/127.0.0.1:1")), *arguments)
    assert bridge.wait() == 2
    bridge.expect(complaint)


def test_clients_of_a_tls_bridge_have_the_rights_of_its_certificate(start: Start, address: str, tmp_path: Path) -> None:
    certificates, tls = make_certificates(tmp_path / "certs"), address.replace("tcp/", "tls/")
    router = listen([tls], credentials=load(certificates / "router", "router"))
    try:
        present: dict[str, bool] = {}
        router.watch_presence("daedalus/r/actors/*/*", present.__setitem__)
        router.serve("daedalus/r/rollouts/*", lambda request: request.reply(b"accepted"))
        identity = ("--tls", certificates / "actor-arm")
        bridge = start("bridge", "--connect", tls, *identity, "--listen", "tcp/127.0.0.1:0")
        with client_of(bridge) as client:
            client.sendall(GREETING)
            for number, name in enumerate(("box", "arm.1")):
                client.sendall(encode_packet(Packet(Kind.ANNOUNCE, number, f"daedalus/r/actors/{name}/7")))
                client.sendall(encode_packet(Packet(Kind.QUERY, number, f"daedalus/r/rollouts/{name}", timeout=5.0)))
            expected = (
                GREETING,
                encode_packet(Packet(Kind.ANSWER, 1, payload=b"accepted")),
                encode_packet(Packet(Kind.END, 1)),
            )
            received = b""
            while not all(part in received for part in expected):
                received += client.recv(4096)
            assert encode_packet(Packet(Kind.ANSWER, 0, payload=b"accepted")) not in received
            until(lambda: present.get("daedalus/r/actors/arm.1/7"))
            assert "daedalus/r/actors/box/7" not in present
    finally:
        router.close()


def test_address_in_use_is_reported(start: Start, address: str, router: Transport) -> None:
    bridge = start("bridge", "--connect", address, "--listen", address)
    assert bridge.wait() == 1
    bridge.expect(f"cannot listen on {address}: Address already in use")
