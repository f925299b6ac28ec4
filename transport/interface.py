"""What the two sides need of a transport, and MemoryTransport, the one for a single process.

    serve / query / query_async           a payload goes to whoever serves the key, answers come back
    publish / subscribe                   the newest value of a key, pushed; only the newest is kept
    declare_presence / watch_presence     who is there, and who has gone

A transport moves bytes. It knows no message, and its callbacks must only hand over: they run on
threads that carry everybody else's traffic too.
"""

from collections.abc import Callable
from typing import Protocol

OnAnswer = Callable[[bytes | None], None]  # takes the answer to a query, or None without one


class TransportError(Exception):
    """The transport cannot do what was asked; the message says what to do about it."""


class AddressInUseError(TransportError):
    """Somebody else listens on that address already."""


class RefusedError(TransportError):
    """Who listens there does not let us in, or cannot be trusted: no waiting mends it."""


class Request(Protocol):
    """One query, held by the side that serves it. Answered at most once, from any thread, or dropped."""

    @property
    def key(self) -> str:
        """The key that was asked."""
        ...

    @property
    def size(self) -> int:
        """How many bytes came with it; asking copies nothing."""
        ...

    @property
    def payload(self) -> bytes:
        """What came with it."""
        ...

    def reply(self, payload: bytes) -> None:
        """Answers; later answers are ignored."""
        ...


class Inbox(Protocol):
    """The newest unread value of a followed key."""

    def close(self) -> None:
        """Follows no more. Idempotent."""
        ...

    def take(self) -> bytes | None:
        """The newest value that was not taken yet, or None. Never waits."""
        ...


class Transport(Protocol):
    """One end of the network. Safe to use from several threads."""

    def serve(self, key: str, handler: Callable[[Request], None]) -> None:
        """Hands every query for `key` (`*` matches one chunk) to `handler`."""
        ...

    def query(self, key: str, payload: bytes = b"", *, timeout: float) -> list[bytes]:
        """Every answer to a query within `timeout` seconds; empty if nobody serves the key."""
        ...

    def query_async(self, key: str, payload: bytes, *, timeout: float, on_answer: OnAnswer) -> None:
        """Queries without waiting; `on_answer` gets the first answer, or None, exactly once."""
        ...

    def publish(self, key: str, payload: bytes) -> None:
        """Pushes a value to all that follow the key; those too slow for it get a later one."""
        ...

    def subscribe(self, key: str, on_news: Callable[[], None]) -> Inbox:
        """Follows a key; `on_news` is called when the inbox may have something new."""
        ...

    def declare_presence(self, key: str) -> None:
        """Declares presence under `key` until this end closes or dies."""
        ...

    def watch_presence(self, key: str, on_change: Callable[[str, bool], None]) -> None:
        """Calls `on_change(key, present)` for all present now and for every change."""
        ...

    def reopen(self, unless_served: str | None = None) -> bool:
        """Starts afresh, with all that was declared, in place of a session that may be dead; whether it did.

        With `unless_served` only if that, seen from outside, nobody serves that key. Raises TransportError if there
        is nothing to connect to; all stays as it was then.
        """
        ...

    def close(self) -> None:
        """Ends everything that this end declared. Idempotent."""
        ...
