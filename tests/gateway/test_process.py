"""`daedalus gateway` as a process, with a real learner."""

import errno
import os
import signal
import socket
import threading
from collections.abc import Callable

import pytest
from gateways import JsonClient
from processes import Running, until
from websockets.exceptions import ConnectionClosed

from daedalus.transport.connecting import connect_with_retry
from daedalus.transport.interface import Transport
from daedalus.transport.status_query import ask

Start = Callable[..., Running]
ENDLESS = ("--set", "training.stop_when_solved=false", "--env-steps", 10**9)
OBSERVATION = [0.01, 0.02, 0.03, 0.04]


def start_gateway(start: Start, address: str, port: int) -> tuple[Running, int]:
    gateway = start("gateway", "--connect", address, "--listen", f"127.0.0.1:{port}")
    return gateway, int(gateway.expect(r"ws://127\.0\.0\.1:(\d+)/actor").group(1))


def trained(transport: Transport, name: str) -> int:
    """Return the env_steps of an actor that the learner trained on."""
    return sum(actor.env_steps for status in ask(transport) for actor in status.actors if actor.actor == name)


def play_until(client: JsonClient, condition: Callable[[], object]) -> None:
    while not condition():
        for _ in range(64):
            assert client.act(OBSERVATION)["type"] == "action"


def test_clients_return_after_their_gateway_was_killed(start: Start, address: str) -> None:
    start("learner", "cartpole", "--listen", address, "--run-dir", "run", *ENDLESS)
    gateway, port = start_gateway(start, address, 0)
    transport = connect_with_retry([address], threading.Event())
    assert transport is not None
    try:
        client = JsonClient(port)
        assert client.hello("phone")["run"] == "run"
        play_until(client, lambda: trained(transport, "phone") > 0)
        gateway.process.kill()
        gateway.wait()
        with pytest.raises((ConnectionClosed, ConnectionError)):
            client.act(OBSERVATION)
        client.close()
        before = trained(transport, "phone")
        gateway, port = start_gateway(start, address, port)
        client = JsonClient(port)
        assert client.hello("phone")["type"] == "welcome"
        play_until(client, lambda: trained(transport, "phone") > before)
        gateway.process.send_signal(signal.SIGTERM)
        assert client.receive()["reason"] == "the gateway stops"
        client.close()
        assert gateway.wait() == 0, gateway.output
        until(lambda: not any(actor.alive for status in ask(transport) for actor in status.actors))
    finally:
        transport.close()


def test_address_in_use_is_reported_in_one_line(start: Start) -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        gateway = start("gateway", "--connect", "tcp/127.0.0.1:1", "--listen", f"127.0.0.1:{port}")
        assert gateway.wait() == 1
    reason = f"{os.strerror(errno.EADDRINUSE)}: choose another --listen"
    assert gateway.lines == [f"daedalus gateway: cannot listen on 127.0.0.1:{port}: {reason}"]


def test_host_that_cannot_be_found_is_reported_in_one_line(start: Start) -> None:
    gateway = start("gateway", "--connect", "tcp/127.0.0.1:1", "--listen", "no.such.host.invalid:0", "--insecure")
    assert gateway.wait() == 1
    (line,) = gateway.lines
    assert line.startswith("daedalus gateway: cannot listen on no.such.host.invalid:0: ")
    assert line.endswith(": choose another --listen")
    assert "Unknown error" not in line


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
