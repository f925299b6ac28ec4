"""The interface that both sides use to reach each other. MemoryTransport and ZenohTransport implement it.

    serve / query / query_async           send a payload to all servers of a key, and receive their answers
    publish / subscribe                   push the values of a key; a subscriber keeps only the newest
    declare_presence / watch_presence     learn which processes appear and disappear

A transport moves bytes and does not know the messages. Callbacks must return quickly, for example put the value on a
queue: they run on threads that carry all other traffic too.
"""

from collections.abc import Callable
from typing import Protocol

OnAnswer = Callable[[bytes | None], None]  # called with the answer to a query, or with None if there is no answer


class TransportError(Exception):
    """The transport cannot perform an operation; the message says why and what to do."""


class AddressInUseError(TransportError):
    """The address is in use by another process."""


class UnreachableError(TransportError):
    """Nothing answered within the time that the user set."""


class RefusedError(TransportError):
    """The other end refuses this certificate, or its own certificate is not trusted: retrying will not help."""


class Request(Protocol):
    """One query as its server receives it: answered at most once, from any thread, or dropped."""

    @property
    def key(self) -> str:
        """Key of the query."""
        ...

    @property
    def size(self) -> int:
        """Number of bytes of the payload; reading this property copies nothing."""
        ...

    @property
    def payload(self) -> bytes:
        """Payload of the query; each access copies it."""
        ...

    def reply(self, payload: bytes) -> None:
        """Send the answer; later calls have no effect.

        Waits while the link to the sender has no room, at most until that link is closed: 5 s after it last had room,
        or 2 s after the last sign of life.
        """
        ...


class Inbox(Protocol):
    """Newest unread value of a subscription."""

    def close(self) -> None:
        """End the subscription. Idempotent."""
        ...

    def take(self) -> bytes | None:
        """Return the newest value that was not taken yet, or None. Never waits."""
        ...


class Declaration(Protocol):
    """What a transport declared to the network."""

    def close(self) -> None:
        """Withdraw it. Idempotent."""
        ...


class QuerySender(Protocol):
    """What sends queries whose answers come later."""

    def query_async(self, key: str, payload: bytes, *, timeout: float, on_answer: OnAnswer) -> None:
        """Send a query without waiting for its answer.

        `on_answer` is called exactly once: with the first answer, or with None after `timeout` seconds. It is not
        called if this method raises TransportError.
        """
        ...


class Transport(QuerySender, Protocol):
    """Connection of one process to the network. Safe to use from several threads.

    Methods raise TransportError if the connection was closed or refuses the operation.
    """

    @property
    def local_address(self) -> str:
        """Address of this end of the connection, such as `tcp/10.0.0.7:43092`; empty if it is not known."""
        ...

    def serve(self, key: str, handler: Callable[[Request], None]) -> None:
        """Call `handler` with every query for `key`, in which `*` matches one chunk."""
        ...

    def query(self, key: str, payload: bytes = b"", *, timeout: float) -> list[bytes]:
        """Return all answers that arrive within `timeout` seconds; an empty list if no process serves the key."""
        ...

    def query_by_key(self, key: str, payload: bytes = b"", *, timeout: float) -> list[tuple[str, bytes]]:
        """Return what `query` does, each answer with the key that its server serves."""
        ...

    def publish(self, key: str, payload: bytes) -> None:
        """Push a value to all subscribers of the key; a subscriber on a congested link may miss values."""
        ...

    def subscribe(self, key: str, on_news: Callable[[], None]) -> Inbox:
        """Subscribe to a key; `on_news` is called when the inbox may hold a new value."""
        ...

    def declare_presence(self, key: str) -> Declaration:
        """Declare presence under `key` until the result or this transport is closed, or the process dies."""
        ...

    def watch_presence(self, key: str, on_change: Callable[[str, bool], None]) -> None:
        """Call `on_change(key, present)` for every key that is present now, and for every change."""
        ...

    def present(self, key: str) -> list[str]:
        """Return every key under which a process is present now, as far as they are known within 5 s."""
        ...

    def reopen(self, unless_served: str | None = None) -> bool:
        """Replace a session that may be dead by a new one that repeats all declarations; return whether it did.

        Does nothing if a query over the new session finds a server of the key `unless_served`. Raises TransportError
        if no session can be opened; the present session then stays in use.
        """
        ...

    def close(self) -> None:
        """End the session and all its declarations. Idempotent."""
        ...
