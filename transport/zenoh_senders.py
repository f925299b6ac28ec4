"""What a session sends with: declared once for each key, because each declaration is a message to all peers."""

import threading

import zenoh

_MAX_QUERIERS = 2048  # kept for further queries; a process may ask under many names


class Senders:
    """The queriers and publishers of one session. Safe to use from several threads. Its methods raise ZError."""

    def __init__(self, session: zenoh.Session) -> None:
        self._session = session
        self._lock = threading.Lock()
        self._queriers: dict[tuple[str, float], zenoh.Querier] = {}  # the one used last is the last
        self._publishers: dict[str, zenoh.Publisher] = {}

    def querier(self, key: str, timeout: float) -> zenoh.Querier:
        """Return the querier of a key; its queries take at most `timeout` seconds."""
        with self._lock:
            querier = self._queriers.pop((key, timeout), None)
            if querier is None:
                if len(self._queriers) >= _MAX_QUERIERS:
                    self._queriers.pop(next(iter(self._queriers)))
                querier = self._session.declare_querier(key, timeout=timeout, express=True)
            self._queriers[key, timeout] = querier
            return querier

    def publisher(self, key: str) -> zenoh.Publisher:
        """Return the publisher of a key, which drops what a congested link cannot take."""
        with self._lock:
            publisher = self._publishers.get(key)
            if publisher is None:
                publisher = self._session.declare_publisher(
                    key,
                    congestion_control=zenoh.CongestionControl.DROP,
                    priority=zenoh.Priority.DATA_HIGH,
                    express=True,
                )
                self._publishers[key] = publisher
            return publisher
