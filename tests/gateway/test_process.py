"""`daedalus gateway` as a process, with a real learner."""

import errno
import os
import re
import signal
import socket
import threading
from collections.abc import Callable
from pathlib import Path

import pytest
from gateways import JsonClient
from processes import ENDLESS, Running, until
from websockets.exceptions import ConnectionClosed

from daedalus.cli.commands.gateway import gateway_options, parser
from daedalus.launch.gateway_process import run_gateway
from daedalus.transport.connecting import connect_with_retry
from daedalus.transport.interface import Transport
from daedalus.transport.status_query import ask

Start = Callable[..., Running]
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


@pytest.mark.parametrize(
    ("arguments", "status", "reason"),
    [
        (
            ("--listen", "no.such.host.invalid:0", "--insecure"),
            1,
            r"cannot listen on no\.such\.host\.invalid:0: (?!.*Unknown error).*: choose another --listen$",
        ),
        (("--listen", "localhost"), 2, "not an address"),
        (("--listen", "0.0.0.0:0"), 2, "is unencrypted and open to every host"),
        (("--connect", "tls/127.0.0.1:1"), 2, "needs certificates: --tls DIR"),
        (("--compare", "nowhere"), 2, r"nowhere has no metrics\.csv: it is no run directory"),
        (("--operator", "certs"), 2, "--operator is for networks with certificates"),
        (("--operator-token", "token"), 2, "token has no token of 16 to 256 characters: delete the file"),
    ],
)
def test_what_cannot_work_is_reported_in_one_line(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    arguments: tuple[str, ...],
    status: int,
    reason: str,
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "token").write_text("short\n")
    words = arguments if "--connect" in arguments else ("--connect", "tcp/127.0.0.1:1", *arguments)
    assert run_gateway(gateway_options(parser().parse_args(words)), threading.Event()) == status
    (line,) = capsys.readouterr().err.splitlines()
    assert re.match(f"daedalus gateway: .*{reason}", line)
