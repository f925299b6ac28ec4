"""Attack: the holder of one client's token against all other users of a gateway.

    python -m benchmarks.attack shared_gateway

It opens as many clients and pages as it can, gives orders without an operator's token, holds 2,100 silent connections,
and sends bytes that are no text. Another client must be admitted and answered and the operator's page opened meanwhile,
no order of the attacker may be carried out, and the log must be a few lines of JSON without a traceback.
"""

import base64
import contextlib
import json
import os
import resource
import socket
import ssl
import struct
import sys
import time
from collections.abc import Callable

from websockets.exceptions import WebSocketException
from websockets.sync.client import ClientConnection, connect

from benchmarks.attack.hostile_clients import HELLO, megabytes
from benchmarks.attack.verdict import Verdict
from benchmarks.chaos.scene import ENDLESS, Scene, scene

_CLIENTS, _PAGES, _SILENT, _ODD = 1100, 64, 2100, 300
_MOST_SECONDS, _MOST_MEGABYTES, _MOST_LINES = 8.0, 700.0, 40
_ORDERS = ("stop", "checkpoint")
_REQUESTS = (
    b"GET /\xff\xfe HTTP/1.1\r\nHost: HOST\r\n\r\n",
    b"GET /page/%ff HTTP/1.1\r\nHost: \xff\r\n\r\n",
    b"GET /watch?\xff HTTP/1.1\r\nHost: HOST\r\nUPGRADE\r\n",
    b"GET /watch HTTP/1.1\r\nHost: HOST\r\nX: \xff\r\nUPGRADE\r\n\x81\x82\0\0\0\0\xff\xfe",
    b"GET /actor HTTP/1.1\r\nHost: HOST\r\nUPGRADE\r\n\x81\x82\0\0\0\0\xff\xfe",
)


def shared_gateway() -> Verdict:
    """Attack a gateway, and return whether its other users noticed."""
    _, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    resource.setrlimit(resource.RLIMIT_NOFILE, (hard, hard))
    with scene() as here, contextlib.ExitStack() as held:
        return _Attack(here, held).run()


class _Attack:
    """The attacker and the honest users of one gateway."""

    def __init__(self, here: Scene, held: contextlib.ExitStack) -> None:
        self._here, self._held = here, held
        for words in (("init",), ("issue", "gateway"), ("issue", "client", "phone", "arm")):
            folder = ["certs"] if words[0] == "init" else ["--directory", "certs"]
            here.start("certs", *words, *folder).wait()
        certificates = here.folder / "certs"
        self._tls = ssl.create_default_context(cafile=certificates / "gateway" / "ca.pem")
        self._tokens = {
            name: (certificates / path / "token").read_text().strip()
            for name, path in (("phone", "client-phone"), ("arm", "client-arm"), ("operator", "operator"))
        }
        here.start("learner", "cartpole", "--listen", here.address, "--run-dir", "run", *ENDLESS)
        serving = ("--serve-tls", certificates / "gateway", "--listen", "127.0.0.1:0", "--log-json")
        self._gateway = here.start("gateway", "--connect", here.address, *serving, "--no-camera")
        self._port = int(self._gateway.expect(r"wss://127\.0\.0\.1:(\d+)/actor").group(1))
        self._gateway.expect("follows run")

    def run(self) -> Verdict:
        before, lines = megabytes(self._gateway.process.pid), len(self._gateway.lines)
        honest = self._play("arm.1")
        seats = sum(self._take_place(number) for number in range(_CLIENTS))
        waits = [self._answered(honest), self._seconds(lambda: self._play("arm.2"))]
        pages = [page for page in (self._page("phone") for _ in range(_PAGES)) if page is not None]
        obeyed = sum(self._order(page, order, "phone") for page in pages[:4] for order in _ORDERS)
        waits.append(self._seconds(self._operate))
        self._held.close()  # what the attacker held
        honest, silent = self._play("arm.3"), self._fall_silent()
        waits += [self._seconds(lambda: self._play("arm.4")), self._seconds(self._operate), self._answered(honest)]
        for connection in silent:
            connection.close()
        self._send_odd_bytes()
        waits.append(self._answered(honest))
        grown = megabytes(self._gateway.process.pid) - before
        logged = [line for line in self._gateway.lines[lines:] if "client" not in line]
        readable = all(_is_json(line) for line in logged) and len(logged) <= _MOST_LINES
        lives = self._gateway.process.poll() is None and self._here.status() is not None
        return Verdict(
            lives and readable and not obeyed and max(waits) < _MOST_SECONDS and grown < _MOST_MEGABYTES,
            f"with {seats:,} clients and {len(pages)} pages under one token, and {len(silent):,} silent connections, "
            f"others waited at most {max(waits):.1f} s; {obeyed} orders without an operator's token were obeyed; the "
            f"gateway {'lives' if lives else 'died'}, grew by {grown:.0f} MiB, and its log has {len(logged)} lines"
            f"{'' if readable else ', NOT all of them JSON or too many'}",
        )

    def _seconds(self, work: Callable[[], object]) -> float:
        began = time.monotonic()
        try:
            work()
        except (WebSocketException, OSError, EOFError, ValueError):
            return float("inf")
        return time.monotonic() - began

    def _open(self, path: str) -> ClientConnection:
        address = f"wss://127.0.0.1:{self._port}/{path}"
        return self._held.enter_context(connect(address, ssl=self._tls, open_timeout=10, close_timeout=0.1))

    def _play(self, name: str) -> ClientConnection:
        """Return an honest client that the gateway has admitted."""
        client = self._open("actor")
        client.send(json.dumps({**HELLO, "name": name, "token": self._tokens["arm"]}))
        if json.loads(client.recv(timeout=10))["type"] != "welcome":
            raise ValueError("the honest client was refused")
        return client

    def _answered(self, client: ClientConnection) -> float:
        def act() -> None:
            client.send(json.dumps({"type": "act", "observation": [0.0] * 4}))
            client.recv(timeout=10)

        return self._seconds(act)

    def _page(self, owner: str) -> ClientConnection | None:
        page = self._open("watch")
        page.send(json.dumps({"type": "hello", "token": self._tokens[owner]}))
        return page if json.loads(page.recv(timeout=10))["type"] == "hello" else None

    def _order(self, page: ClientConnection, order: str, owner: str) -> bool:
        """Give an order, and return whether it was accepted."""
        page.send(json.dumps({"type": "order", "order": order, "token": self._tokens[owner]}))
        with contextlib.suppress(WebSocketException, TimeoutError):
            while (answer := json.loads(page.recv(timeout=5))["type"]) not in ("ordered", "refused", "error"):
                pass
            return answer == "ordered"
        return False

    def _operate(self) -> None:
        """Open an operator's page, and save a checkpoint."""
        page = self._page("operator")
        if page is None or not self._order(page, "checkpoint", "operator"):
            raise ValueError("the operator's page was refused")

    def _take_place(self, number: int) -> bool:
        """Hold a client of the attacker, without a thread for it."""
        with contextlib.suppress(OSError):
            connection = self._held.enter_context(self._encrypted())
            hello = json.dumps({**HELLO, "name": f"phone.{number}", "token": self._tokens["phone"]}).encode()
            frame = b"\x81" + struct.pack("!BH", 0x80 | 126, len(hello)) + bytes(4) + hello
            connection.sendall(self._filled(b"GET /actor HTTP/1.1\r\nHost: HOST\r\nUPGRADE\r\n") + frame)
            return connection.recv(12) == b"HTTP/1.1 101"
        return False

    def _fall_silent(self) -> list[socket.socket]:
        silent = []
        for _ in range(_SILENT):
            with contextlib.suppress(OSError):
                silent.append(socket.create_connection(("127.0.0.1", self._port), 5.0))
        return silent

    def _send_odd_bytes(self) -> None:
        for number in range(_ODD):
            with contextlib.suppress(OSError), self._encrypted() as connection:
                connection.sendall(self._filled(_REQUESTS[number % len(_REQUESTS)]))
                connection.recv(4096)

    def _encrypted(self) -> ssl.SSLSocket:
        plain = socket.create_connection(("127.0.0.1", self._port), 10.0)
        plain.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        return self._tls.wrap_socket(plain, server_hostname="127.0.0.1")

    def _filled(self, request: bytes) -> bytes:
        key = base64.b64encode(os.urandom(16))
        upgrade = b"Upgrade: websocket\r\nConnection: Upgrade\r\nSec-WebSocket-Version: 13\r\nSec-WebSocket-Key: "
        return request.replace(b"HOST", b"127.0.0.1:%d" % self._port).replace(b"UPGRADE", upgrade + key + b"\r\n")


def _is_json(line: str) -> bool:
    try:
        return isinstance(json.loads(line), dict)
    except ValueError:
        return False


if __name__ == "__main__":
    verdict = shared_gateway()
    print(verdict)
    sys.exit(0 if verdict.held else 1)
