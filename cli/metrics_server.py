"""The HTTP server of `daedalus exporter`: prometheus_client's application, with limits on its connections."""

import contextlib
import socket
import threading
from socketserver import ThreadingMixIn
from typing import Any, cast
from wsgiref.simple_server import WSGIRequestHandler, WSGIServer

from prometheus_client import CollectorRegistry, make_wsgi_app

_QUIET_SECONDS = 10.0  # a connection that sends or takes nothing for as long is ended
_MAX_CONNECTIONS = 64  # each has a thread


class _Handler(WSGIRequestHandler):
    """Handler that waits for a limited time, and logs no requests."""

    timeout = _QUIET_SECONDS

    def parse_request(self) -> bool:
        """Note that the connection is not a silent one."""
        cast(MetricsServer, self.server).asked(self.connection)
        return super().parse_request()

    def log_message(self, format: str, *args: Any) -> None:
        """Log nothing."""


class MetricsServer(ThreadingMixIn, WSGIServer):
    """Server with a thread for each connection.

    Beyond the limit, the oldest connection without a request is ended, and the oldest of all if each has one.
    """

    daemon_threads = True

    def __init__(self, host: str, port: int, registry: CollectorRegistry) -> None:
        """Listen. `serve_forever` serves until `shutdown`. Raises OSError."""
        family, _, _, _, address = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE)[0]
        self.address_family = family
        self._open: dict[socket.socket, bool] = {}  # whether a request has come; oldest first
        self._lock = threading.Lock()
        super().__init__((str(address[0]), port), _Handler)
        self.set_app(make_wsgi_app(registry))

    def process_request(self, request: Any, client_address: Any) -> None:
        """Serve a connection in a thread."""
        with self._lock:
            if len(self._open) >= _MAX_CONNECTIONS:
                oldest = next((one for one, has_asked in self._open.items() if not has_asked), next(iter(self._open)))
                del self._open[oldest]
                with contextlib.suppress(OSError):  # it has ended
                    oldest.shutdown(socket.SHUT_RDWR)  # its thread notices, and closes it
            self._open[request] = False
        super().process_request(request, client_address)

    def asked(self, connection: socket.socket) -> None:
        """Note that a connection has sent a request."""
        with self._lock:
            if connection in self._open:
                self._open[connection] = True

    def shutdown_request(self, request: Any) -> None:
        """Close a connection."""
        with self._lock:
            self._open.pop(request, None)
        super().shutdown_request(request)

    def handle_error(self, request: Any, client_address: Any) -> None:
        """Say nothing of a client that has left or was too slow."""
