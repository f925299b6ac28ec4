"""Who may use a gateway: tokens, TLS, origins and hosts; and the limits of one client."""

import contextlib
import gc
import json
import socket
import ssl
import urllib.error
import urllib.request
import weakref
from asyncio.transports import BaseTransport
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from gateways import JsonClient, RunningGateway
from processes import LIMIT, until
from scripted_learner import ScriptedLearner
from websockets.exceptions import ConnectionClosed, InvalidMessage, InvalidStatus

from daedalus.cli.commands.certs import certs
from daedalus.gateway import server
from daedalus.gateway.errors import ClientError
from daedalus.gateway.rate_limit import RateLimit
from daedalus.gateway.security import guard
from daedalus.gateway.tokens import TOKENS, Tokens, digest
from daedalus.transport.memory import MemoryNetwork

Connect = Callable[..., JsonClient]


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Certificates of a gateway, and tokens of two clients."""
    made = tmp_path_factory.mktemp("certificates") / "certs"
    assert certs(["init", str(made)]) == 0
    assert certs(["issue", "gateway", "--directory", str(made)]) == 0
    assert certs(["issue", "client", "phone", "arm", "--directory", str(made)]) == 0
    return made


@pytest.fixture
def secured(folder: Path, network: MemoryNetwork, learner: ScriptedLearner) -> Iterator[RunningGateway]:
    running = RunningGateway(network, folder / "gateway")
    yield running
    running.close()
    assert running.failure is None


def token(folder: Path, name: str) -> str:
    return (folder / f"client-{name}" / "token").read_text().strip()


def secure_client(gateway: RunningGateway, folder: Path) -> JsonClient:
    """A client that trusts the CA in the folder of its token."""
    context = ssl.create_default_context(cafile=folder / "client-phone" / "ca.pem")
    return JsonClient(gateway.port, scheme="wss", ssl=context)


def test_token_admits_its_own_name_only(secured: RunningGateway, folder: Path) -> None:
    for name, given, expected in [
        ("phone", token(folder, "phone"), "welcome"),
        ("phone.2", token(folder, "phone"), "welcome"),
        ("arm", token(folder, "phone"), "error"),
        ("phonetic", token(folder, "phone"), "error"),
        ("phone", "", "error"),
        ("unknown", token(folder, "phone"), "error"),
    ]:
        client = secure_client(secured, folder)
        answer = client.hello(name, token=given)
        client.close()
        assert answer["type"] == expected, (name, answer)
        if expected == "error":
            assert "daedalus certs issue client NAME" in answer["reason"]


def test_clients_over_tls_get_no_session_ticket_while_they_send(secured: RunningGateway, folder: Path) -> None:
    context = ssl.create_default_context(cafile=folder / "client-phone" / "ca.pem")
    address = ("127.0.0.1", secured.port)
    with (
        socket.create_connection(address, timeout=LIMIT) as plain,
        context.wrap_socket(plain, server_hostname="127.0.0.1") as client,
    ):
        client.sendall(b"GET / HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n")
        assert client.recv(9) == b"HTTP/1.1 "  # a ticket would have come before it
        assert client.version() == "TLSv1.3"
        assert client.session is None or not client.session.has_ticket


def test_connection_without_tls_is_not_served(secured: RunningGateway) -> None:
    with pytest.raises(Exception, match=r"did not receive a valid HTTP response|connection|closed"):
        JsonClient(secured.port)


def test_revoked_and_expired_tokens_are_refused_without_a_restart(tmp_path: Path) -> None:
    made = tmp_path / "certs"
    assert certs(["init", str(made)]) == 0
    assert certs(["issue", "client", "phone", "--directory", str(made)]) == 0
    assert certs(["issue", "gateway", "--directory", str(made)]) == 0  # tokens of before are its own too
    tokens, given = Tokens(made / "gateway"), token(made, "phone")
    tokens.check("phone", given)
    record = made / "gateway" / TOKENS
    record.write_text(json.dumps({"phone": {"sha256": digest(given), "expires": 1.0}}))
    with pytest.raises(ClientError, match="the token has expired"):
        tokens.check("phone", given)
    assert certs(["renew", "client", "phone", "--directory", str(made)]) == 0
    with pytest.raises(ClientError, match="not one of this name"):
        tokens.check("phone", given)
    renewed = token(made, "phone")
    tokens.check("phone", renewed)
    assert certs(["revoke", "client", "phone", "--directory", str(made)]) == 0
    with pytest.raises(ClientError, match="not one of this name"):
        tokens.check("phone", renewed)
    assert not (made / "client-phone").exists()
    record.unlink()
    with pytest.raises(ClientError, match="cannot read its tokens"):
        tokens.check("phone", renewed)


@pytest.mark.parametrize("content", ["[]", "{", '{"a": {"sha256": "00", "expires": 1}}', '{"a": {"sha256": 1}}'])
def test_damaged_tokens_are_refused_at_the_start(tmp_path: Path, content: str) -> None:
    (tmp_path / TOKENS).write_text(content)
    with pytest.raises(ValueError, match=r"damaged|not a map|Expecting"):
        Tokens(tmp_path)


def test_token_files_are_readable_by_their_owner_only_and_keep_no_token(folder: Path) -> None:
    for path in (folder / "client-phone" / "token", folder / "gateway" / TOKENS, folder / "ca" / TOKENS):
        assert path.stat().st_mode & 0o077 == 0
    assert token(folder, "phone") not in (folder / "gateway" / TOKENS).read_text()


def test_list_shows_tokens(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    capsys.readouterr()
    assert certs(["list", "--directory", str(folder)]) == 0
    listed = capsys.readouterr().out
    assert "client-phone" in listed
    assert "gateway " in listed


@pytest.mark.parametrize(
    ("headers", "status"),
    [
        ({}, 200),
        ({"Origin": "http://localhost:PORT"}, 200),
        ({"Origin": "http://evil.example"}, 403),
        ({"Origin": "http://localhost:1"}, 403),
        ({"Origin": "null"}, 403),
        ({"Host": "evil.example"}, 403),
        ({"Host": "evil.example:PORT", "Origin": "http://evil.example:PORT"}, 403),
    ],
)
def test_requests_of_other_pages_and_under_other_names_are_refused(
    learner: ScriptedLearner, gateway: RunningGateway, headers: dict[str, str], status: int
) -> None:
    filled = {name: value.replace("PORT", str(gateway.port)) for name, value in headers.items()}
    request = urllib.request.Request(f"http://127.0.0.1:{gateway.port}/protocol.json", headers=filled)
    try:
        with urllib.request.urlopen(request, timeout=LIMIT) as answer:
            found, policy = answer.status, answer.headers["Content-Security-Policy"]
    except urllib.error.HTTPError as error:
        found, policy = error.code, error.headers["Content-Security-Policy"]
        error.close()
    assert found == status
    assert "default-src 'none'" in policy
    assert "unsafe" not in policy


def test_page_of_another_site_cannot_open_a_websocket(learner: ScriptedLearner, connect: Connect) -> None:
    with pytest.raises(InvalidStatus) as refused:
        connect(origin="http://evil.example")
    assert refused.value.response.status_code == 403
    assert b"allow them with --allow-origin" in refused.value.response.body


def test_allowed_origins_and_names_are_the_gateways_and_those_of_the_user() -> None:
    rules = guard(["localhost", "play.example"], 443, ["https://other.example/"], tokens=object())  # type: ignore[arg-type] - not used
    assert rules.refusal([(b"host", b"play.example"), (b"origin", b"https://play.example")]) == ""
    assert rules.refusal([(b"host", b"Play.Example:443"), (b"origin", b"https://other.example")]) == ""
    assert "may not connect" in rules.refusal([(b"host", b"play.example"), (b"origin", b"http://play.example")])
    assert "does not serve the host" in rules.refusal([])


def test_client_that_sends_too_fast_waits() -> None:
    limit = RateLimit(rate=10.0, burst=3.0)
    assert [limit.take(100.0) for _ in range(3)] == [0.0] * 3
    assert limit.take(100.0) == pytest.approx(0.1)
    assert limit.take(100.0) == pytest.approx(0.2)
    assert limit.take(100.5) == 0.0


def test_connection_without_a_request_is_closed(
    learner: ScriptedLearner, gateway: RunningGateway, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(server, "_REQUEST_SECONDS", 0.3)
    with socket.create_connection(("127.0.0.1", gateway.port), LIMIT) as silent:
        silent.sendall(b"GET /actor HTTP/1.1\r\nHost:")
        assert silent.recv(1) == b""


def test_connection_without_a_tls_handshake_is_closed(
    network: MemoryNetwork, folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(server, "_REQUEST_SECONDS", 0.3)
    running = RunningGateway(network, folder / "gateway", follows=False)
    try:
        address = ("127.0.0.1", running.port)
        with (
            socket.create_connection(address, LIMIT / 4) as silent,  # asyncio's own limit is 60 s
            contextlib.suppress(ConnectionResetError),
        ):
            assert silent.recv(1) == b""
    finally:
        running.close()


def test_large_first_messages_that_do_not_end_are_limited_and_the_oldest_ends(
    learner: ScriptedLearner, gateway: RunningGateway, connect: Connect, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(server, "_MAX_NEWCOMERS", 2)
    known = []
    for number in range(3):
        known.append(connect())
        assert known[-1].hello(f"c-{number}")["type"] == "welcome"
    part = b"\x81\xff" + (200_000).to_bytes(8, "big") + bytes(4) + b"x" * 20_000  # a text of 200,000 bytes begins
    silent = [connect() for _ in range(3)]
    begun = [connect() for _ in range(3)]
    for client in begun:
        client.socket.socket.sendall(part)
        for _ in range(2):
            gateway.call(lambda: None)  # its event loop has read the part
    with pytest.raises(ConnectionClosed):
        begun[0].receive()
    assert [client.hello(f"s-{number}")["type"] for number, client in enumerate(silent)] == ["welcome"] * 3
    assert all(client.act([0.0, 0.0, 0.0, 0.0])["type"] == "action" for client in known)
    for client in begun[1:]:
        client.socket.socket.sendall(b"x" * 180_000)
        assert client.receive()["code"] == "malformed", "it was not ended"


def test_connections_are_limited(learner: ScriptedLearner, connect: Connect, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(server, "_MAX_CONNECTIONS", 2)
    clients = [connect() for _ in range(2)]
    with pytest.raises((InvalidMessage, ConnectionError, EOFError)):
        connect()
    assert [client.hello(f"c-{number}")["type"] for number, client in enumerate(clients)] == ["welcome"] * 2


def test_connection_without_a_further_request_is_closed(
    learner: ScriptedLearner, gateway: RunningGateway, monkeypatch: pytest.MonkeyPatch
) -> None:
    request = f"HEAD / HTTP/1.1\r\nHost: localhost:{gateway.port}\r\n\r\n".encode()
    monkeypatch.setattr(server, "_REQUEST_SECONDS", 1e6)
    with socket.create_connection(("127.0.0.1", gateway.port), LIMIT) as slow, slow.makefile("rb") as answers:

        def ask() -> None:
            slow.sendall(request)
            assert answers.readline().startswith(b"HTTP/1.1 200")
            while answers.readline().strip():
                pass

        ask()
        monkeypatch.setattr(server, "_REQUEST_SECONDS", 0.3)
        ask()
        slow.sendall(b"G")  # uvicorn's own deadline ends with it
        with contextlib.suppress(ConnectionResetError):
            assert answers.read(1) == b""


def deaf_socket(port: int) -> socket.socket:
    """Return a connection that takes few bytes until somebody reads."""
    made = socket.socket()
    made.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
    made.settimeout(LIMIT)
    made.connect(("127.0.0.1", port))
    return made


def send_for_ever(client: socket.socket, data: bytes) -> None:
    while True:
        client.sendall(data)


def test_connection_whose_answers_nobody_reads_is_closed(
    learner: ScriptedLearner, gateway: RunningGateway, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(server, "_REQUEST_SECONDS", 0.3)
    requests = f"GET /page/style.css HTTP/1.1\r\nHost: localhost:{gateway.port}\r\n\r\n".encode() * 100
    with deaf_socket(gateway.port) as deaf, pytest.raises(ConnectionError):
        send_for_ever(deaf, requests)


def test_client_that_reads_neither_answers_nor_pings_is_disconnected(
    learner: ScriptedLearner, gateway: RunningGateway, monkeypatch: pytest.MonkeyPatch
) -> None:
    gateway.listener.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, 4096)
    made: list[server.OurWebSocket] = []
    connection_made = server.OurWebSocket.connection_made
    monkeypatch.setattr(
        server.OurWebSocket,
        "connection_made",
        lambda channel, transport: made.append(channel) or connection_made(channel, transport),
    )
    client = JsonClient(gateway.port, sock=deaf_socket(gateway.port), max_queue=1, close_timeout=1.0)  # nobody answers
    try:
        assert client.hello("deaf")["type"] == "welcome"
        for _ in range(1000):
            client.send("act", observation=[0.0, 0.0, 0.0, 0.0])
        until(lambda: gateway.call(lambda: made[0].transport.get_write_buffer_size()) > 0)
        gateway.call(made[0].keepalive_timeout)
        until(lambda: not gateway.call(lambda: gateway.gateway._seats))
    finally:
        client.close()


def test_ended_connections_are_forgotten(
    learner: ScriptedLearner, gateway: RunningGateway, connect: Connect, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(server, "_REQUEST_SECONDS", 1e6)
    made: list[weakref.ref[server.PromptHttp]] = []
    connection_made = server.PromptHttp.connection_made

    def noted(connection: server.PromptHttp, transport: BaseTransport) -> None:
        made.append(weakref.ref(connection))
        connection_made(connection, transport)

    monkeypatch.setattr(server.PromptHttp, "connection_made", noted)
    for request in (b"", b"GET / HTTP/1.1\r\nX: " + b"x" * 200_000, b"GET / HTTP/1.1\r\nHost: localhost\r\n\r\n"):
        with socket.create_connection(("127.0.0.1", gateway.port), LIMIT) as connection:
            connection.sendall(request)
    client = connect()
    client.hello("phone")
    client.close()

    def forgotten() -> bool:
        gc.collect()
        return len(made) == 4 and not any(reference() for reference in made)

    until(forgotten)


def test_gateway_that_stops_ends_connections_whose_clients_do_not_answer(network: MemoryNetwork, folder: Path) -> None:
    running = RunningGateway(network, folder / "gateway", follows=False)
    with socket.create_connection(("127.0.0.1", running.port), LIMIT) as connection:
        trusting = ssl.create_default_context(cafile=folder / "client-phone" / "ca.pem")
        encrypted = trusting.wrap_socket(connection, server_hostname="127.0.0.1")
        encrypted.sendall(f"GET /protocol.json HTTP/1.1\r\nHost: 127.0.0.1:{running.port}\r\n\r\n".encode())
        assert encrypted.recv(1) == b"H"
        with socket.socket(fileno=encrypted.detach()) as silent:  # it does not say that it ends its side of TLS
            running.close()
            silent.settimeout(LIMIT)
            with contextlib.suppress(ConnectionResetError):
                while silent.recv(4096):
                    pass
