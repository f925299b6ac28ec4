"""Queries, values and presence in Zenoh: the payload stays in Zenoh's buffers until it is read."""

import threading
from collections.abc import Callable

import zenoh

from daedalus.protocol import keys


class ZenohRequest:
    """A query that Zenoh delivered; finalised as soon as it is answered or garbage-collected."""

    __slots__ = ("_buffers", "_query", "key", "size")

    def __init__(self, query: zenoh.Query, served: str) -> None:
        self._query: zenoh.Query | None = query
        self._buffers = query.payload
        self.key = keys.intersection(served, str(query.key_expr))
        self.size = 0 if self._buffers is None else len(self._buffers)

    @property
    def payload(self) -> bytes:
        """See Request."""
        return b"" if self._buffers is None else self._buffers.to_bytes()

    def reply(self, payload: bytes) -> None:
        """See Request."""
        query, self._query = self._query, None
        if query is None:
            return
        try:
            query.reply(self.key, payload)
            query.drop()
        except zenoh.ZError:
            pass  # the sender of the query is gone, or our session is closing: nobody waits for this answer


class ZenohInbox:
    """The newest unread value of one subscription, still in Zenoh's buffers."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._newest: zenoh.ZBytes | None = None
        self.undeclare: Callable[[], None] = lambda: None

    def put(self, payload: zenoh.ZBytes) -> None:
        """Replace the newest value."""
        with self._lock:
            self._newest = payload

    def take(self) -> bytes | None:
        """See Inbox."""
        with self._lock:
            newest, self._newest = self._newest, None
        return None if newest is None else newest.to_bytes()

    def close(self) -> None:
        """See Inbox."""
        self.undeclare()


class ZenohPresence:
    """A declared presence."""

    def __init__(self, undeclare: Callable[[], None]) -> None:
        self._undeclare = undeclare

    def close(self) -> None:
        """See Declaration."""
        self._undeclare()
