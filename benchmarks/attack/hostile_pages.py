"""Attack: browsers that break every rule of a gateway's page: at /watch, with orders and the camera, and over HTTP.

    python -m benchmarks.attack hostile_pages

An honest page must receive news all the while and see the camera, an honest client must be answered, no order may be
carried out, nothing outside the page's own files may be read, and the gateway's memory must stay small.
"""

import contextlib
import json
import logging
import random
import socket
import sys
import threading
import time

from websockets.exceptions import WebSocketException
from websockets.sync.client import ClientConnection, connect

from benchmarks.attack.hostile_clients import megabytes, play
from benchmarks.attack.verdict import Verdict
from benchmarks.chaos.scene import ENDLESS, Scene, scene

_SECONDS = 15.0
_READERS_THAT_STALL = 10
_MOST_SECONDS, _MOST_MEGABYTES = 6.0, 64.0  # of the honest page without news, and of growth
_HELLO = json.dumps({"type": "hello", "token": ""})
_FILES = (
    b"/etc/passwd",
    b"/page/../server.py",
    b"/page/..%2f..%2ftokens.py",
    b"/page/%2e%2e/app.py",
    b"/page//etc/passwd",
)


def _messages(chosen: random.Random) -> list[str | bytes]:
    """Return messages that no honest page sends."""
    token = "".join(chosen.choices("abcdefghijklmnopqrstuvwxyz-_", k=43))
    return [
        "{", "[" * 100_000, "null", b"\x00" * 1000, b"\xff" * 100, _HELLO, " " * 300_000, '{"type":"camera"}',
        json.dumps({"type": "order", "order": "stop", "token": token}),
        json.dumps({"type": "order", "order": "checkpoint", "token": ""}),
        json.dumps({"type": "order", "order": "\x1b[2J<script>alert(1)</script>", "token": token}),
        json.dumps({"type": "order", "order": ["stop"], "token": {"a": 1}}),
        json.dumps({"type": "order", "order": "stop", "token": "é" * 1000}),
        json.dumps({"type": "camera", "on": True}), json.dumps({"type": "camera", "on": False}),
        json.dumps({"type": "camera", "on": "yes"}),
    ]  # fmt: skip


def _requests(port: int) -> list[bytes]:
    """Return requests that no honest browser sends."""
    host = b"Host: 127.0.0.1:%d\r\n" % port
    upgrade = b"Upgrade: websocket\r\nConnection: Upgrade\r\nSec-WebSocket-Version: 13\r\n"
    return [
        *(b"GET %b HTTP/1.1\r\n%b\r\n" % (path, host) for path in _FILES),
        b"GET /play HTTP/1.1\r\nHost: evil.example\r\n\r\n",
        b"GET /watch HTTP/1.1\r\n%b%bOrigin: http://evil.example\r\nSec-WebSocket-Key: %b\r\n\r\n"
        % (host, upgrade, b"A" * 22 + b"=="),
        b"GET /watch HTTP/1.1\r\n%b%b\r\n" % (host, upgrade),  # without a key
        b"GET / HTTP/1.1\r\n%bX: %b\r\n\r\n" % (host, b"x" * 200_000),
        b"POST /play HTTP/1.1\r\n%bContent-Length: 99999999999\r\n\r\n%b" % (host, b"x" * 10_000),
        b"GET /watch HTTP/1.1\r\n%b\r\n" % host,  # no WebSocket
        b"\x16\x03\x01" * 100,
    ]


class _HonestPage:
    """A page that watches with the camera."""

    def __init__(self, port: int, until: float, token: str) -> None:
        self.news = self.pictures = 0
        self.longest_silence = 0.0
        self._port, self._until, self._token = port, until, token
        self.thread = threading.Thread(target=self._watch)
        self.thread.start()

    def _watch(self) -> None:
        with connect(f"ws://127.0.0.1:{self._port}/watch", max_size=None) as page:
            page.send(json.dumps({"type": "hello", "token": self._token}))
            page.send(json.dumps({"type": "camera", "on": True}))
            last = time.monotonic()
            while time.monotonic() < self._until:
                message = page.recv(timeout=60)
                if isinstance(message, bytes):
                    self.pictures += 1
                    continue
                self.longest_silence = max(self.longest_silence, time.monotonic() - last)
                self.news, last = self.news + 1, time.monotonic()


def hostile_pages() -> Verdict:
    """Attack the page of a gateway for some seconds, and return whether anybody noticed."""
    logging.getLogger("websockets").setLevel(logging.CRITICAL)  # of the attackers, whose connections are cut
    with scene() as here:
        return _attack_all(here)


def _attack_all(here: Scene) -> Verdict:
    here.start("learner", "cartpole", "--listen", here.address, "--run-dir", "run", *ENDLESS)
    options = ["--listen", "127.0.0.1:0", "--operator-token", "operator.token"]
    gateway = here.start("gateway", "--connect", here.address, *options, "--log-level", "info")
    port = int(gateway.expect(r"ws://127\.0\.0\.1:(\d+)/actor").group(1))
    gateway.expect("follows run")
    until = time.monotonic() + 8.0 + _SECONDS
    steps: list[float] = []
    honest = threading.Thread(target=play, args=(port, until, steps))
    honest.start()
    here.wait_for_training("honest")
    token = (here.folder / "operator.token").read_text().strip()
    page = _HonestPage(port, until, token)
    before = megabytes(gateway.process.pid)
    leaks: list[bytes] = []
    attackers = [
        *(threading.Thread(target=_attack_page, args=(port, until, seed)) for seed in range(3)),
        threading.Thread(target=_attack_server, args=(port, until, leaks)),
    ]
    with contextlib.ExitStack() as stalled:
        for thread in attackers:
            thread.start()
        for _ in range(_READERS_THAT_STALL):
            stalled.enter_context(_stalled_page(port, token))
        for thread in (*attackers, honest, page.thread):
            thread.join()
        grown = megabytes(gateway.process.pid) - before
    escaped = all(line.isprintable() for line in gateway.lines)
    obeyed = any("a page orders" in line for line in gateway.lines) or here.status() is None
    alive = gateway.process.poll() is None
    return Verdict(
        alive
        and escaped
        and not obeyed
        and not leaks
        and len(steps) > 0
        and page.pictures > 0
        and page.longest_silence < _MOST_SECONDS
        and grown < _MOST_MEGABYTES,
        f"the honest page received {page.news} messages, at most {page.longest_silence:.1f} s apart, and "
        f"{page.pictures} pictures; the honest client took {len(steps):,} steps, the slowest {max(steps):.2f} s; the "
        f"gateway grew by {grown:.0f} MiB and {'lives' if alive else 'died'}; {'AN' if obeyed else 'no'} order was "
        f"carried out, {len(leaks)} files were read; its log {'is' if escaped else 'IS NOT'} printable",
    )


def _stalled_page(port: int, token: str) -> ClientConnection:
    """Return a page of the operator that asks for everything and reads nothing."""
    page = connect(f"ws://127.0.0.1:{port}/watch", max_queue=1, close_timeout=0.1)
    page.send(json.dumps({"type": "hello", "token": token}))
    page.send(json.dumps({"type": "camera", "on": True}))
    return page


def _attack_page(port: int, until: float, seed: int) -> None:
    chosen = random.Random(seed)
    while time.monotonic() < until:
        with (
            contextlib.suppress(WebSocketException, OSError, EOFError, TimeoutError),
            connect(f"ws://127.0.0.1:{port}/watch", open_timeout=5, close_timeout=0.5, max_size=None) as page,
        ):
            if chosen.random() < 0.8:
                page.send(_HELLO)
            for _ in range(chosen.randrange(30)):
                page.send(chosen.choice(_messages(chosen)))
            for _ in range(chosen.randrange(3)):
                page.recv(timeout=0.2)


def _attack_server(port: int, until: float, leaks: list[bytes]) -> None:
    while time.monotonic() < until:
        for request in _requests(port):
            with contextlib.suppress(OSError), socket.create_connection(("127.0.0.1", port), 2.0) as connection:
                connection.sendall(request)
                answer = connection.recv(65536)
                if any(path in request for path in _FILES) and answer.startswith(b"HTTP/1.1 200"):
                    leaks.append(request)


if __name__ == "__main__":
    verdict = hostile_pages()
    print(verdict)
    sys.exit(0 if verdict.held else 1)
