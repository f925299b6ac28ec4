"""`daedalus gateway` as a process, with clients that run the policy themselves."""

import json
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from certificates import make_certificates
from processes import LIMIT, Running, until
from websockets.sync.client import connect

from daedalus.gateway.raw.packets import GREETING, Kind, Packet, encode_packet
from daedalus.transport.credentials import load
from daedalus.transport.interface import Transport
from daedalus.transport.zenoh_transport import listen

Start = Callable[..., Running]
HELLO = json.dumps({"type": "hello", "version": 1, "name": "wing"})


@pytest.fixture
def router(address: str) -> Iterator[Transport]:
    one = listen([address])
    yield one
    one.close()


def raw_address(gateway: Running) -> str:
    port = gateway.expect(r"clients connect to ws://127.0.0.1:(\d+)")[1]
    return f"ws://127.0.0.1:{port}/raw"


def test_stop_during_a_query_ends_the_gateway_and_its_presence(start: Start, address: str, router: Transport) -> None:
    present: dict[str, bool] = {}
    held = []
    router.watch_presence("daedalus/r/actors/*/*", present.__setitem__)
    router.serve("daedalus/r/status", held.append)
    gateway = start("gateway", "--connect", address, "--listen", "127.0.0.1:0")
    with connect(raw_address(gateway), open_timeout=LIMIT) as client:
        client.send(HELLO)
        client.send(GREETING + encode_packet(Packet(Kind.ANNOUNCE, 1, "daedalus/r/actors/wing/7")))
        client.send(encode_packet(Packet(Kind.QUERY, 2, "daedalus/r/status", timeout=60.0)))
        until(lambda: held and present.get("daedalus/r/actors/wing/7"))
        gateway.process.terminate()
        assert gateway.wait() == 0, gateway.output
        until(lambda: present["daedalus/r/actors/wing/7"] is False)


def test_clients_of_a_gateway_have_the_rights_of_its_certificate(start: Start, address: str, tmp_path: Path) -> None:
    certificates, tls = make_certificates(tmp_path / "certs"), address.replace("tcp/", "tls/")
    router = listen([tls], credentials=load(certificates / "router", "router"))
    try:
        present: dict[str, bool] = {}
        router.watch_presence("daedalus/r/actors/*/*", present.__setitem__)
        router.serve("daedalus/r/rollouts/*", lambda request: request.reply(b"accepted"))
        identity = ("--tls", certificates / "actor-arm")
        gateway = start("gateway", "--connect", tls, *identity, "--listen", "127.0.0.1:0")
        with connect(raw_address(gateway), open_timeout=LIMIT) as client:
            client.send(HELLO)
            client.send(GREETING)
            for number, name in enumerate(("box", "arm.1")):
                client.send(encode_packet(Packet(Kind.ANNOUNCE, number, f"daedalus/r/actors/{name}/7")))
                client.send(encode_packet(Packet(Kind.QUERY, number, f"daedalus/r/rollouts/{name}", timeout=5.0)))
            expected = (
                GREETING,
                encode_packet(Packet(Kind.ANSWER, 1, payload=b"accepted")),
                encode_packet(Packet(Kind.END, 1)),
            )
            received = b""
            while not all(part in received for part in expected):
                message = client.recv(timeout=LIMIT)
                assert isinstance(message, bytes), message
                received += message
            assert encode_packet(Packet(Kind.ANSWER, 0, payload=b"accepted")) not in received
            until(lambda: present.get("daedalus/r/actors/arm.1/7"))
            assert "daedalus/r/actors/box/7" not in present
    finally:
        router.close()


@pytest.mark.parametrize(
    ("arguments", "complaint"),
    [
        (("--listen", "localhost"), "not an address"),
        (("--listen", "0.0.0.0:0"), "is unencrypted and open to every host"),
        (("--connect", "tls/127.0.0.1:1"), "needs certificates: --tls DIR"),
    ],
    ids=str,
)
def test_bad_usage_is_reported(start: Start, arguments: tuple[str, ...], complaint: str) -> None:
    gateway = start("gateway", *(() if "--connect" in arguments else ("--connect", "tcp/127.0.0.1:1")), *arguments)
    assert gateway.wait() == 2
    gateway.expect(complaint)
