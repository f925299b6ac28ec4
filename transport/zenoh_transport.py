"""The Transport over Zenoh.

Only the files named `zenoh_*.py` import Zenoh. What Zenoh needs of its user (measured, see docs/results.md):
  - Congestion control BLOCK is not flow control: Zenoh disconnects a peer that stalls, and drops all that the peer
    had queued. So rollouts are queries that are answered, and snapshots are put with DROP.
  - A process that ends with a callback declared and its session open hangs for ever: call `close` in a `finally`.
  - Closing a dead connection blocks one of two receiving threads for 10 s: `LingerRemoval` prevents this.
"""

import contextlib
import functools
import logging
import os
import socket
import struct
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import zenoh

from daedalus.protocol.limits import LEARNER_LIMITS
from daedalus.transport.credentials import Credentials, CredentialsError, CredentialsWatch
from daedalus.transport.interface import Declaration, Inbox, OnAnswer, Request, Transport, TransportError
from daedalus.transport.slow_calls import SlowCall
from daedalus.transport.zenoh_declarations import (
    Callbacks,
    Declarations,
    Declared,
    Senders,
    ZenohInbox,
    ZenohPresence,
    ZenohRequest,
)
from daedalus.transport.zenoh_session import OpenSession, error_text, resolved, session_opener
from daedalus.transport.zenoh_settings import MAX_MESSAGE_BYTES

_DESCRIPTORS = Path("/dev/fd")  # of this process
_LINGER = struct.Struct("ii")  # whether close() waits, and for how many seconds
_ZENOHS_LINGER = _LINGER.pack(1, 10)
_PAUSE_SECONDS = 0.5  # so that many connections that are opened at the same time are found together


class LingerRemoval:
    """Removal of the option from every connection of this process. Has its own thread, which never ends."""

    def __init__(self) -> None:
        self._changed = threading.Event()
        threading.Thread(target=self._remove_repeatedly, name="linger removal", daemon=True).start()

    def connections_changed(self, *_: Any) -> None:
        """Note that a connection was opened. From any thread."""
        self._changed.set()

    def _remove_repeatedly(self) -> None:
        while self._changed.wait():
            time.sleep(_PAUSE_SECONDS)
            self._changed.clear()
            remove_linger()


@functools.cache
def linger_removal() -> LingerRemoval:
    """Return the one of this process."""
    return LingerRemoval()


def remove_linger() -> None:
    """Remove the option that Zenoh sets from all connections of this process."""
    for entry in os.listdir(_DESCRIPTORS) if _DESCRIPTORS.is_dir() else ():
        with contextlib.suppress(OSError):  # not a socket, or closed meanwhile
            _remove_from(int(entry))


def _remove_from(descriptor: int) -> None:
    # The family has no effect on the option. `detach` leaves the descriptor open: it is Zenoh's.
    connection = socket.socket(socket.AF_INET, socket.SOCK_STREAM, fileno=descriptor)
    try:
        if connection.getsockopt(socket.SOL_SOCKET, socket.SO_LINGER, _LINGER.size) == _ZENOHS_LINGER:
            connection.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, _LINGER.pack(0, 0))
    finally:
        connection.detach()


_logger = logging.getLogger(__name__)

_CLOSE_SECONDS = 2.0  # Zenoh waits up to 10 s for a router that does not answer
_PRESENT_SECONDS = 5.0  # for a query of presence
_PROBE_SECONDS = 2.0  # for the query that checks whether a key is served
_RENEW_SECONDS, _RENEW_PAUSE_SECONDS = 10.0, 0.05  # for the address of a closed session to become free


def listen(
    endpoints: list[str],
    connect: list[str] | None = None,
    credentials: Credentials | None = None,
    *,
    max_message_bytes: int = MAX_MESSAGE_BYTES,
) -> "ZenohTransport":
    """Open a router that listens on `endpoints` and connects to the routers at `connect`.

    Endpoints are `tcp/HOST:PORT` or `tls/HOST:PORT`. With `credentials` the router admits the names that their folder
    lists, and connections over plain TCP; when a file of the folder changes, the session is renewed. The router drops
    messages above `max_message_bytes`.
    Raises AddressInUseError, TransportError or CredentialsError.
    """
    opener = session_opener("router", endpoints, connect or [], credentials, max_message_bytes)
    transport = ZenohTransport(opener, is_client=False)
    if credentials is not None:
        transport.watch(credentials)
    return transport


def connect(
    endpoints: list[str],
    credentials: Credentials | None = None,
    *,
    max_message_bytes: int = LEARNER_LIMITS.message_bytes,
) -> Transport:
    """Open a client of the router at one of `endpoints`; it does not receive messages above `max_message_bytes`.

    Raises TransportError at once if none of them can be reached, RefusedError if retrying will not help.
    """
    opener = session_opener("client", [], endpoints, credentials, max_message_bytes)
    return ZenohTransport(opener, is_client=True)


@contextlib.contextmanager
def _as_transport_error(action: str) -> Iterator[None]:
    try:
        yield
    except zenoh.ZError as error:
        raise TransportError(f"cannot {action}: {error_text(error)}") from None


def _answers(session: zenoh.Session, key: str, payload: bytes, timeout: float) -> list[tuple[str, bytes]]:
    """Return every answer to a query within `timeout` seconds, with its key."""
    replies = session.get(
        key,
        payload=payload,
        timeout=timeout,
        target=zenoh.QueryTarget.ALL,
        consolidation=zenoh.ConsolidationMode.NONE,  # otherwise one answer for each key, not for each server
    )
    return [(str(reply.ok.key_expr), reply.ok.payload.to_bytes()) for reply in replies if reply.ok is not None]


class ZenohTransport:
    """A Transport over one Zenoh session; `reopen` replaces the session and repeats the declarations."""

    def __init__(self, open_session: OpenSession, *, is_client: bool) -> None:
        """Open the session; `open_session` raises TransportError if that fails."""
        self._open_session = open_session
        self._is_client = is_client
        self._session = open_session()
        self._closed = self._warned_of_size = False
        self._declarations = Declarations(self._session)
        self._senders = Senders(self._session)
        self._lock = threading.Lock()
        self._callbacks = Callbacks()
        self._watch: CredentialsWatch | None = None
        self._declarations.add(self._listener_of_connections)

    def _listener_of_connections(self, session: zenoh.Session) -> Declared:
        callback = self._callbacks.hold(linger_removal().connections_changed)
        return session.info.declare_link_events_listener(callback, history=True)

    @property
    def local_address(self) -> str:
        """See Transport. A Unix socket has no address at this end: it is the name of the protocol alone."""
        with contextlib.suppress(zenoh.ZError):
            for link in self._session.info.links():
                return link.src.partition("/")[0] if link.src.startswith("unixsock") else link.src
        return ""

    def unreached(self, endpoints: list[str]) -> list[str]:
        """Return those of the endpoints to whose hosts there is no connection, whichever end has opened it."""
        try:
            reached = {link.dst.rpartition(":")[0] for link in self._session.info.links()}
        except zenoh.ZError:  # the session was closed, or is being renewed
            return []
        return [each for each in endpoints if not reached & {one.rpartition(":")[0] for one in resolved(each)}]

    def serve(self, key: str, handler: Callable[[Request], None]) -> None:
        """See Transport."""

        def on_query(query: zenoh.Query) -> None:
            handler(ZenohRequest(query, key))

        with _as_transport_error(f"serve {key}"):
            self._declarations.add(
                lambda session: session.declare_queryable(key, self._callbacks.hold(on_query), complete=True)
            )

    def query(self, key: str, payload: bytes = b"", *, timeout: float) -> list[bytes]:
        """See Transport."""
        return [answer for _, answer in self.query_by_key(key, payload, timeout=timeout)]

    def query_by_key(self, key: str, payload: bytes = b"", *, timeout: float) -> list[tuple[str, bytes]]:
        """See Transport."""
        with _as_transport_error(f"query {key}"):
            return _answers(self._session, key, payload, timeout)

    def query_async(self, key: str, payload: bytes, *, timeout: float, on_answer: OnAnswer) -> None:
        """See Transport."""
        first: list[bytes] = []
        ended = threading.Lock()  # acquired by the first to report the end: Zenoh's thread, or the error raised here

        def on_reply(reply: zenoh.Reply) -> None:
            if reply.ok is not None and not first:
                first.append(reply.ok.payload.to_bytes())

        def on_end() -> None:
            if ended.acquire(blocking=False):
                on_answer(first[0] if first else None)

        with _as_transport_error(f"query {key}"):
            querier = self._senders.querier(key, timeout)
            try:
                querier.get(self._callbacks.hold(on_reply, on_end), payload=payload)
            except zenoh.ZError:  # Zenoh then releases the callback too, on another thread
                if ended.acquire(blocking=False):
                    raise

    def publish(self, key: str, payload: bytes) -> None:
        """See Transport."""
        if self._is_client and len(payload) > MAX_MESSAGE_BYTES and not self._warned_of_size:
            self._warned_of_size = True
            _logger.warning(
                "a snapshot has %.0f MiB: start the routers with a --max-message-megabytes above this size; "
                "by default they drop messages above %d MiB",
                len(payload) / 2**20,
                MAX_MESSAGE_BYTES >> 20,
            )
        with _as_transport_error(f"publish {key}"):
            self._senders.publisher(key).put(payload)

    def subscribe(self, key: str, on_news: Callable[[], None]) -> Inbox:
        """See Transport."""
        inbox = ZenohInbox()

        def on_sample(sample: zenoh.Sample) -> None:
            inbox.put(sample.payload)
            on_news()

        def declare(session: zenoh.Session) -> Declared:
            return session.declare_subscriber(key, self._callbacks.hold(on_sample))

        with _as_transport_error(f"subscribe to {key}"):
            self._declarations.add(declare)
        inbox.undeclare = lambda: self._declarations.remove(declare)
        return inbox

    def declare_presence(self, key: str) -> Declaration:
        """See Transport."""

        def declare(session: zenoh.Session) -> Declared:
            return session.liveliness().declare_token(key)

        with _as_transport_error(f"declare presence under {key}"):
            self._declarations.add(declare)
        return ZenohPresence(lambda: self._declarations.remove(declare))

    def watch_presence(self, key: str, on_change: Callable[[str, bool], None]) -> None:
        """See Transport."""
        present: set[str] = set()

        def on_sample(sample: zenoh.Sample) -> None:
            name, is_there = str(sample.key_expr), sample.kind == zenoh.SampleKind.PUT
            (present.add if is_there else present.discard)(name)
            on_change(name, is_there)

        def declare(session: zenoh.Session) -> Declared:
            # As the previous session saw it: the new subscriber reports again what is still present.
            for name in list(present):
                present.discard(name)
                on_change(name, False)
            # Without history the subscriber sometimes misses a token that is declared just after it.
            return session.liveliness().declare_subscriber(key, self._callbacks.hold(on_sample), history=True)

        with _as_transport_error(f"watch presence under {key}"):
            self._declarations.add(declare)

    def present(self, key: str) -> list[str]:
        """See Transport."""
        with _as_transport_error(f"query presence under {key}"):
            replies = self._session.liveliness().get(key, timeout=_PRESENT_SECONDS)
            return [str(reply.ok.key_expr) for reply in replies if reply.ok is not None]

    def reopen(self, unless_served: str | None = None) -> bool:
        """See Transport. A router is never reopened: its address would still be in use by itself."""
        if not self._is_client:
            return False
        session = self._open_session()
        try:
            with _as_transport_error(f"query {unless_served}"):
                is_served = unless_served is not None and bool(_answers(session, unless_served, b"", _PROBE_SECONDS))
        except TransportError:
            session.close()
            raise
        if is_served:
            session.close()
            return False
        return self._replace(session)

    def watch(self, credentials: Credentials) -> None:
        """Renew the session of a router whenever a file of its credentials changes.

        Zenoh reads certificates and access control only when a session is opened. All peers lose their connection and
        connect again, if they are still authorised.
        """
        self._watch = CredentialsWatch(credentials, self._renew)
        self._watch.open()

    def _renew(self) -> None:
        """Close the session of a router, so that its address is free, and open another.

        Raises TransportError or CredentialsError if that fails repeatedly.
        """
        self._session.close()
        deadline = time.monotonic() + _RENEW_SECONDS
        while not self._closed:
            try:
                session = self._open_session()
            except (TransportError, CredentialsError):  # the address is in use, or a file is being copied
                if time.monotonic() > deadline:
                    raise
                time.sleep(_RENEW_PAUSE_SECONDS)
            else:
                self._replace(session)
                return

    def _replace(self, session: zenoh.Session) -> bool:
        """Use another session and repeat the declarations in it; return False if the transport was closed."""
        with self._lock:
            if self._closed:
                session.close()
                return False
            self._session, self._senders = session, Senders(session)
        with _as_transport_error("repeat the declarations"):
            self._declarations.move_to(session)
        return True

    def close(self) -> None:
        """See Transport."""
        with self._lock:
            self._closed = True
            session = self._session
        if self._watch is not None:
            self._watch.close()
        if not session.is_closed():
            with contextlib.suppress(TimeoutError, zenoh.ZError):  # of a router that does not answer
                SlowCall(session.close).result.result(_CLOSE_SECONDS)
                self._callbacks.await_release()
