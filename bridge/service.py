"""Lets clients in, each with a transport of its own, and ends them all when told to stop."""

import contextlib
import logging
import socket
import threading
from collections.abc import Callable

from daedalus.bridge.connection import ClientConnection
from daedalus.transport.interface import Transport

_logger = logging.getLogger(__name__)

_MOST_CLIENTS = 64  # at once
_HEARTBEAT_SECONDS = 0.2  # how soon a wait notices that it should stop
_END_SECONDS = 4.0  # for all clients together, when told to stop


class Bridge:
    """All clients of one listening socket, each with a transport of its own."""

    def __init__(self, listener: socket.socket, open_transport: Callable[[], Transport]) -> None:
        self._listener = listener
        self._open_transport = open_transport
        self._clients: dict[ClientConnection, threading.Thread] = {}

    def run(self, stop: threading.Event) -> None:
        """Serves whoever comes until told to stop; then ends them all."""
        self._listener.settimeout(_HEARTBEAT_SECONDS)
        try:
            while not stop.is_set():
                with contextlib.suppress(TimeoutError, ConnectionError):
                    self._welcome(*self._listener.accept())
                self._clients = {client: thread for client, thread in self._clients.items() if thread.is_alive()}
        finally:
            self._listener.close()
            for client in self._clients:
                client.close()
            for thread in self._clients.values():
                thread.join(_END_SECONDS / len(self._clients))

    def _welcome(self, connection: socket.socket, address: tuple[str, int]) -> None:
        name = f"{address[0]}:{address[1]}"
        if len(self._clients) >= _MOST_CLIENTS:
            connection.close()
            _logger.info(f"turned {name} away: {_MOST_CLIENTS} clients are here already")
            return
        client = ClientConnection(connection, self._open_transport)
        thread = threading.Thread(target=self._serve, args=(client, name), name="bridge-client", daemon=True)
        self._clients[client] = thread
        thread.start()

    def _serve(self, client: ClientConnection, name: str) -> None:
        _logger.info(f"{name} came")
        reason = client.run()
        _logger.info(f"{name} was given up: {reason}" if reason else f"{name} went")
