"""The bridge's listening socket: accepts clients, and closes them all when stopped."""

import contextlib
import logging
import socket
import threading
from collections.abc import Callable

from daedalus.bridge.clients import ClientTable
from daedalus.bridge.connection import ClientConnection
from daedalus.transport.interface import Transport

_logger = logging.getLogger(__name__)

_HEARTBEAT_SECONDS = 0.2  # between checks of the stop event
_END_SECONDS = 4.0  # for all clients to end after a stop


class Bridge:
    """Server of one listening socket; each client gets its own transport."""

    def __init__(self, listener: socket.socket, open_transport: Callable[[], Transport]) -> None:
        self._listener = listener
        self._open_transport = open_transport
        self._table = ClientTable()
        self._clients: dict[ClientConnection, threading.Thread] = {}

    def run(self, stop: threading.Event) -> None:
        """Serve clients until `stop` is set, then close all connections."""
        self._listener.settimeout(_HEARTBEAT_SECONDS)
        try:
            while not stop.is_set():
                try:
                    with contextlib.suppress(TimeoutError, ConnectionError):
                        self._accept(*self._listener.accept())
                except OSError as error:  # such as too many open files, which end with their connections
                    _logger.warning("cannot accept a connection: %s", error)
                    stop.wait(_HEARTBEAT_SECONDS)
                self._clients = {client: thread for client, thread in self._clients.items() if thread.is_alive()}
        finally:
            self._listener.close()
            for client in self._clients:
                client.close()
            for thread in self._clients.values():
                thread.join(_END_SECONDS / len(self._clients))

    def _accept(self, connection: socket.socket, address: tuple[str, int]) -> None:
        name = f"{address[0]}:{address[1]}"
        client = ClientConnection(connection, self._open_transport, self._table)
        self._table.connect(client)
        thread = threading.Thread(target=self._serve, args=(client, name), name="bridge-client", daemon=True)
        self._clients[client] = thread
        thread.start()

    def _serve(self, client: ClientConnection, name: str) -> None:
        _logger.info("%s connected", name)
        reason = client.run()
        if reason:
            _logger.warning("%s was disconnected: %s", name, reason)
        else:
            _logger.info("%s disconnected", name)
