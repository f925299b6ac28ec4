"""Who may use a gateway: tokens, TLS, origins and hosts; and the limits of one client."""

import contextlib
import functools
import gc
import json
import logging
import os
import resource
import socket
import ssl
import subprocess
import sys
import urllib.error
import urllib.request
import weakref
from asyncio.transports import BaseTransport
from collections.abc import Callable, Iterator
from contextlib import closing
from pathlib import Path

import pytest
from certificates import change_certificates, make_certificates
from gateways import JsonClient, RunningGateway
from processes import LIMIT, until
from scripted_learner import ScriptedLearner
from websockets.exceptions import ConnectionClosed

from daedalus.gateway import app, places, server
from daedalus.gateway.client_messages import ClientError
from daedalus.gateway.security import TOKENS, RateLimit, Tokens, digest, guard
from daedalus.transport.memory import MemoryNetwork

Connect = Callable[..., JsonClient]


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Certificates of a gateway, and tokens of two clients."""
    return make_certificates(tmp_path_factory.mktemp("certificates") / "certs", "gateway", "client phone arm")


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
    made = make_certificates(tmp_path / "certs", "client phone", "gateway")  # tokens of before are its own too
    tokens, given = Tokens(made / "gateway"), token(made, "phone")
    tokens.check("phone", given)
    record = made / "gateway" / TOKENS
    record.write_text(json.dumps({"phone": {"sha256": digest(given), "expires": 1.0}}))
    with pytest.raises(ClientError, match="the token has expired"):
        tokens.check("phone", given)
    change_certificates(made, "renew client phone")
    with pytest.raises(ClientError, match="not one of this name"):
        tokens.check("phone", given)
    renewed = token(made, "phone")
    tokens.check("phone", renewed)
    change_certificates(made, "revoke client phone")
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
    change_certificates(folder, "list")
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


@pytest.mark.parametrize("path", ["/actor", "/watch"])
@pytest.mark.parametrize(
    ("origin", "host", "reason"),
    [
        ("http://evil.example", "", b"allow them with --allow-origin"),
        ("null", "", b"allow them with --allow-origin"),
        ("http://127.0.0.1:1", "", b"allow them with --allow-origin"),  # another program on this machine
        ("http://evil.example:PORT", "evil.example:PORT", b"add it with --host"),  # DNS rebinding
    ],
)
def test_page_of_another_site_cannot_open_a_websocket(
    gateway: RunningGateway, path: str, origin: str, host: str, reason: bytes
) -> None:
    port, request = (
        str(gateway.port),
        f"GET {path} HTTP/1.1\r\nHost: {host or '127.0.0.1:PORT'}\r\nOrigin: {origin}\r\n",
    )
    with (
        socket.create_connection(("127.0.0.1", gateway.port), LIMIT) as connection,
        connection.makefile("rb") as answer,
    ):
        connection.sendall(request.replace("PORT", port).encode() + HANDSHAKE + b"\r\n")
        content = answer.read()
    assert content.startswith(b"HTTP/1.1 403")
    assert reason in content


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
    with closing(RunningGateway(network, folder / "gateway", follows=False)) as running:
        address = ("127.0.0.1", running.port)
        with (
            socket.create_connection(address, LIMIT / 4) as silent,  # asyncio's own limit is 60 s
            contextlib.suppress(ConnectionResetError),
        ):
            assert silent.recv(1) == b""


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


def ended(connection: socket.socket) -> bool:
    """Return whether the other end has closed a connection."""
    connection.settimeout(LIMIT)
    try:
        return connection.recv(1) == b""
    except ConnectionResetError:
        return True


@pytest.mark.parametrize("secure", [False, True])
def test_of_silent_connections_the_oldest_give_way_and_clients_stay(
    network: MemoryNetwork, folder: Path, learner: ScriptedLearner, monkeypatch: pytest.MonkeyPatch, secure: bool
) -> None:
    monkeypatch.setattr(server, "_REQUEST_SECONDS", 1e6)
    monkeypatch.setattr(server, "most_connections", lambda: 12)
    with closing(RunningGateway(network, folder / "gateway" if secure else None)) as running:
        connect = functools.partial(secure_client, running, folder) if secure else lambda: JsonClient(running.port)
        known, given = connect(), token(folder, "phone") if secure else ""
        assert known.hello("phone.1", token=given)["type"] == "welcome"
        waiting = [socket.create_connection(("127.0.0.1", running.port), LIMIT) for _ in range(20)]
        late = connect()
        assert late.hello("phone.2", token=given)["type"] == "welcome"
        assert all(ended(connection) for connection in waiting[:15])
        assert known.act([0.0, 0.0, 0.0, 0.0])["type"] == "action"
        for client in (known, late, *waiting):
            client.close()


def test_address_with_the_most_silent_connections_gives_way_first(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(server, "most_connections", lambda: 16)
    crowd, given_way = server.Crowd(), list[str]()

    def add(name: str, address: str) -> server.Link:
        link = server.Link(address, lambda: given_way.append(name))
        crowd.add(link)
        return link

    add("honest", "10.0.0.1")
    add("attacker 1", "2001:db8::1")
    settled = add("client", "10.0.0.2")
    crowd.settle(settled)
    add("attacker 2", "2001:db8::2")
    add("attacker 3", "2001:db8::ffff:3")  # an IPv6 network is one address
    assert given_way == []
    add("attacker 4", "2001:db8::4")
    add("another", "10.0.0.3")
    assert given_way == ["attacker 1", "attacker 2"]
    for _ in range(15):
        crowd.settle(add("client", "10.0.0.2"))  # clients take the places of the silent, and never give way
    assert "client" not in given_way
    assert len(given_way) == 6


def test_gateway_has_descriptors_left_for_itself(monkeypatch: pytest.MonkeyPatch) -> None:
    limits = {1024: 768, 256: 128, 1 << 20: 2048, resource.RLIM_INFINITY: 2048}
    for limit, most in limits.items():
        monkeypatch.setattr(resource, "getrlimit", lambda _, limit=limit: (limit, limit))
        assert places.most_connections() == most


def test_owner_with_the_most_places_gives_one_to_an_owner_with_fewer() -> None:
    seats, gone = places.Places(4, "clients", reserved=1), list[str]()
    with contextlib.ExitStack() as stack:

        def take(owner: str, name: str, **options: bool) -> None:
            stack.enter_context(seats.take(owner, lambda error: gone.append(name), **options))

        for number in range(4):
            take("greedy", f"greedy {number}")
        with pytest.raises(ClientError, match="4 clients are connected already: try again later"):
            take("greedy", "greedy 4")
        take("arm", "arm 0")
        take("arm", "arm 1")
        assert gone == ["greedy 3", "greedy 2"]
        with pytest.raises(ClientError, match="already"):
            take("arm", "arm 2")  # it would have more than the other
        take("operator:alice", "alice", is_operator=True)  # nobody gives way
        assert (gone, seats.taken) == (["greedy 3", "greedy 2"], 5)
    assert seats.taken == 0


def test_one_token_does_not_shut_out_others(
    network: MemoryNetwork, folder: Path, learner: ScriptedLearner, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(app, "MAX_CLIENTS", 3)
    with closing(RunningGateway(network, folder / "gateway")) as running:
        phone, arm = token(folder, "phone"), token(folder, "arm")
        greedy = [secure_client(running, folder) for _ in range(3)]
        for number, client in enumerate(greedy):
            assert client.hello(f"phone.{number}", token=phone)["type"] == "welcome"
        for name, given, answer in (("phone.3", phone, "error"), ("arm", arm, "welcome")):
            client = secure_client(running, folder)
            assert client.hello(name, token=given)["type"] == answer
            client.close()
        ending = greedy[2].receive()
        assert (ending["code"], "another needs one" in ending["reason"]) == ("unavailable", True)
        assert greedy[0].act([0.0, 0.0, 0.0, 0.0])["type"] == "action"
        for client in greedy:
            client.close()


@pytest.mark.skipif(sys.platform != "linux" or os.geteuid() != 0, reason="only root can be another user")
def test_peers_on_this_machine_are_its_users() -> None:
    code = "import socket; s = socket.create_connection(('127.0.0.1', {})); s.recv(1)"
    python = next(filter(os.path.exists, ("/usr/bin/python3", "/usr/local/bin/python3", sys.executable)))
    with socket.create_server(("127.0.0.1", 0)) as listener:
        listener.settimeout(LIMIT)
        command = [python, "-I", "-c", code.format(listener.getsockname()[1])]
        process = subprocess.Popen(command, user=65534, cwd="/")
        connection, remote = listener.accept()
        with connection:
            assert places.peer_of("127.0.0.1", connection.getsockname(), remote) == "user 65534"
        process.wait()
    assert places.peer_of("192.0.2.7", ("192.0.2.1", 1), ("192.0.2.7", 1)) == "192.0.2.7"


HANDSHAKE = b"Upgrade: websocket\r\nConnection: Upgrade\r\nSec-WebSocket-Version: 13\r\nSec-WebSocket-Key: "
HANDSHAKE += b"A" * 22 + b"==\r\n"
ODD_REQUESTS = [
    b"GET /\xff\xfe HTTP/1.1\r\nHost: localhost:PORT\r\n\r\n",
    b"GET /page/%ff%fe%00 HTTP/1.1\r\nHost: localhost:PORT\r\n\r\n",
    b"GET /?\xff=%ff HTTP/1.1\r\nHost: localhost:PORT\r\n\r\n",
    b"GET / HTTP/1.1\r\nHost: \xff\r\nX: \xff\xfe\r\n\r\n",
    b"GET / HTTP/1.1\r\nHost: localhost:PORT\r\nX-\xff: a\r\n\r\n",
    b"\xff\xff / HTTP/1.1\r\n\r\n",
    b"GET http://[::1 HTTP/1.1\r\nHost: localhost:PORT\r\n\r\n",
    *(
        b"GET PATH HTTP/1.1\r\nHost: localhost:PORT\r\n".replace(b"PATH", path) + HANDSHAKE + more + b"\r\n" + frames
        for path in (b"/actor", b"/watch", b"/none")
        for more in (b"", b"X: \xff\xfe\r\n", b"Origin: http://\xff\r\n", b"Sec-WebSocket-Protocol: \xff,\xfe\r\n")
        for frames in (
            b"",
            b"\x81\x82\0\0\0\0\xff\xfe",
            b"\x88\x84\0\0\0\0\x03\xe8\xff\xfe",
            b"\xff\xff",
            b"\x83\x80\0\0\0\0",
        )
    ),
    b"GET /watch?\xff HTTP/1.1\r\nHost: localhost:PORT\r\n" + HANDSHAKE + b"\r\n",
    b"GET /%ff%fe?%ff=%fe HTTP/1.1\r\nHost: localhost:PORT\r\n" + HANDSHAKE + b"\r\n",
]


def test_bytes_that_are_no_text_make_no_traceback_and_few_lines(
    learner: ScriptedLearner,
    gateway: RunningGateway,
    connect: Connect,
    caplog: pytest.LogCaptureFixture,
    capfd: pytest.CaptureFixture[str],
) -> None:
    for request in ODD_REQUESTS:
        with socket.create_connection(("127.0.0.1", gateway.port), LIMIT) as connection:
            connection.sendall(request.replace(b"PORT", b"%d" % gateway.port))
            connection.shutdown(socket.SHUT_WR)
            with contextlib.suppress(ConnectionResetError):
                while connection.recv(65536):
                    pass
    client = connect()
    assert client.hello("phone")["type"] == "welcome"
    client.socket.socket.sendall(b"\x81\x82\0\0\0\0\xff\xfe")
    with pytest.raises(ConnectionClosed) as closed:
        client.receive()
    assert closed.value.rcvd is not None
    assert closed.value.rcvd.code == 1007
    assert not any(record.exc_info for record in caplog.records)
    lines = [record.getMessage() for record in caplog.records if record.name == server.__name__]
    assert len(lines) <= 2, lines
    assert capfd.readouterr() == ("", "")


def test_what_the_libraries_log_is_one_line_and_is_counted(
    caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    handler, log = server.OneLine(), logging.Logger("uvicorn.error")
    log.addHandler(handler)
    monkeypatch.setattr(server, "_LINE_SECONDS", 3600.0)
    try:
        raise ValueError("several\nlines")
    except ValueError:
        for _ in range(1000):
            log.exception("Exception in ASGI application\n")
        handler.next_at = 0.0
        log.exception("Exception in ASGI application\n")
    first, second = [record.getMessage() for record in caplog.records]
    assert first.startswith("Exception in ASGI application: ValueError: several lines (test_security.py:")
    assert second.endswith("(999 records before this one were left out)")


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
    # Nobody answers.
    with closing(JsonClient(gateway.port, sock=deaf_socket(gateway.port), max_queue=1, close_timeout=1.0)) as client:
        assert client.hello("deaf")["type"] == "welcome"
        for _ in range(1000):
            client.send("act", observation=[0.0, 0.0, 0.0, 0.0])
        until(lambda: gateway.call(lambda: made[0].transport.get_write_buffer_size()) > 0)
        gateway.call(made[0].keepalive_timeout)
        until(lambda: not gateway.call(lambda: gateway.gateway._seats))


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
