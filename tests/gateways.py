"""A gateway in this process, over any transport, and clients that speak its protocol by hand."""

import asyncio
import contextlib
import json
import socket
import threading
from collections.abc import Callable
from concurrent.futures import Future
from pathlib import Path
from typing import Any

from processes import LIMIT
from websockets.sync.client import ClientConnection, connect

from daedalus.gateway.app import application
from daedalus.gateway.client_gateway import Gateway, GatewayConfig
from daedalus.gateway.security import LOOPBACK, OperatorToken, Tokens, guard
from daedalus.gateway.server import Server, tls_context
from daedalus.gateway.watching.page_data import PageData
from daedalus.transport.memory import MemoryNetwork, MemoryTransport

CARTPOLE = {
    "observations": {"observation": {"kind": "array", "shape": [4], "dtype": "float32"}},
    "actions": {"action": {"kind": "discrete", "counts": [2]}},
}


class RunningGateway:
    """A gateway with its web server, on a thread of its own."""

    def __init__(
        self,
        network: MemoryNetwork,
        certificates: Path | None = None,
        *,
        follows: bool = True,
        operator: OperatorToken | None = None,
        takes_clients: bool = True,
        reads_openly: bool = True,
        record: str = "",
    ) -> None:
        """Start a gateway.

        Args:
          network: the network that it connects to.
          certificates: folder of a gateway; None: plain WebSockets on loopback.
          operator: token for the page.
          takes_clients: whether it has clients, or the page only.
          reads_openly: whether the page needs no token if there is none.
          follows: whether it follows a run; otherwise it serves its page only.
          record: dataset of its clients' episodes; empty: none.
        """
        self._follows, self._operator, self._reads_openly = follows, operator, reads_openly
        self._takes_clients = takes_clients
        self._transport = MemoryTransport(network)
        self._tokens = None if certificates is None else Tokens(certificates)
        self._tls = None if certificates is None else tls_context(certificates)
        self._config = GatewayConfig(name="gateway", record=record)
        self.listener = socket.create_server(("127.0.0.1", 0))
        self.port = self.listener.getsockname()[1]
        self.failure: Exception | None = None
        self.loop = asyncio.new_event_loop()
        self._stop = asyncio.Event()
        ready: Future[Gateway] = Future()
        self._thread = threading.Thread(target=lambda: self.loop.run_until_complete(self._serve(ready)), daemon=True)
        self._thread.start()
        self.gateway = ready.result(LIMIT)

    async def _serve(self, ready: "Future[Gateway]") -> None:
        gateway = Gateway(self._transport, self._config, self._fail)
        if self._follows:
            gateway.open()
        self.data = PageData(takes_clients=self._takes_clients)
        ready.set_result(gateway)
        rules = guard(LOOPBACK, self.port, [], self._tokens, self._operator, reads_openly=self._reads_openly)
        reached: asyncio.Future[Gateway] = self.loop.create_future()
        reached.set_result(gateway)
        await Server(application(reached, rules, self.data), self._tls).run_until(
            self._stop, self.listener, gateway.close
        )

    def _fail(self, error: Exception) -> None:
        self.failure = error
        self._stop.set()

    def call(self, function: Callable[[], Any]) -> Any:
        """Return what a function returns on the gateway's event loop."""
        result: Future[Any] = Future()
        self.loop.call_soon_threadsafe(lambda: result.set_result(function()))
        return result.result(LIMIT)

    def close(self) -> None:
        self.loop.call_soon_threadsafe(self._stop.set)
        self._thread.join(LIMIT)
        assert not self._thread.is_alive()
        self.loop.close()


class JsonClient:
    """A client, as it would be written in another language."""

    def __init__(self, port: int, scheme: str = "ws", **options: Any) -> None:
        address = f"{scheme}://127.0.0.1:{port}/actor"
        self._stack = contextlib.ExitStack()
        self.socket: ClientConnection = self._stack.enter_context(
            connect(address, **{"open_timeout": LIMIT, "close_timeout": LIMIT, **options})
        )

    def send(self, kind: str, **fields: Any) -> None:
        self.socket.send(json.dumps({"type": kind, **fields}))

    def receive(self) -> dict[str, Any]:
        return json.loads(self.socket.recv(timeout=LIMIT))

    def hello(self, name: str, spaces: dict[str, Any] = CARTPOLE, **fields: Any) -> dict[str, Any]:
        self.send("hello", **{"version": 1, "name": name, **spaces, **fields})
        return self.receive()

    def act(self, observation: Any, **fields: Any) -> dict[str, Any]:
        self.send("act", observation=observation, **fields)
        return self.receive()

    def close(self) -> None:
        self._stack.close()
