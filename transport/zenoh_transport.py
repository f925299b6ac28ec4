"""The Transport over Zenoh: the only file that imports it.

A session either embeds a full router that listens (the learner, by default) or is a client of one.

What Zenoh needs to be held to (measured, see docs/results.md):
  - BLOCK is not flow control: a peer that stalls is disconnected with all it had. So rollouts are
    queries that are answered, and snapshots are put with DROP.
  - A process that ends with a callback declared and its session open hangs for ever: `close` belongs
    in a `finally`.
  - One that ends while Zenoh's threads still hold callbacks aborts now and then: `close` waits until they do not.
"""

import contextlib
import json
import threading
from collections.abc import Callable, Iterator
from typing import Any, Literal

import zenoh

from daedalus.transport.credentials import Credentials, diagnose_connection
from daedalus.transport.interface import (
    AddressInUseError,
    Inbox,
    OnAnswer,
    RefusedError,
    Request,
    Transport,
    TransportError,
)
from daedalus.transport.zenoh_settings import session_settings

_PROBE_SECONDS = 2.0  # for a look from outside
_LEAVING_SECONDS = 2.0  # for Zenoh to let go of callbacks when a session is closed


def listen(endpoints: list[str], connect: list[str] | None = None, credentials: Credentials | None = None) -> Transport:
    """Opens a router that listens on `endpoints` (`tcp/HOST:PORT`, `tls/HOST:PORT`) and may join other routers.

    With `credentials` it lets in whom they name, and those that come over plain TCP.
    Raises AddressInUseError, TransportError, or CredentialsError.
    """
    return _open("router", endpoints, connect or [], credentials)


def connect(endpoints: list[str], credentials: Credentials | None = None) -> Transport:
    """Opens a client of the router at one of `endpoints`.

    Raises TransportError at once if none of them can be reached, RefusedError if that is for good.
    """
    return _open("client", [], endpoints, credentials)


def _open(
    mode: Literal["router", "client"],
    listen_on: list[str],
    connect_to: list[str],
    credentials: Credentials | None,
) -> "ZenohTransport":
    config = zenoh.Config()
    security = credentials.settings(listens=bool(listen_on)) if credentials else {}
    settings = session_settings(mode, listen_on, connect_to, security)

    def open_session() -> zenoh.Session:
        try:
            for name, value in settings.items():
                config.insert_json5(name, json.dumps(value))
            return zenoh.open(config)
        except zenoh.ZError as error:
            raise _opening_error(str(error), listen_on, connect_to, credentials) from None

    return ZenohTransport(open_session, is_client=mode == "client")


def _opening_error(
    text: str, listen_on: list[str], connect_to: list[str], credentials: Credentials | None
) -> TransportError:
    if "in use" in text:
        return AddressInUseError(
            f"address {', '.join(listen_on)} is already in use: "
            "stop what listens there, or choose another with --listen"
        )
    if connect_to:
        reasons = [diagnose_connection(endpoint, credentials) for endpoint in connect_to]
        for_good = all(final for _, final in reasons)
        return (RefusedError if for_good else TransportError)("; ".join(reason for reason, _ in reasons))
    return TransportError(f"cannot listen on {', '.join(listen_on)}: {text.splitlines()[0][:200]}")


@contextlib.contextmanager
def _as_transport_error(what: str) -> Iterator[None]:
    try:
        yield
    except zenoh.ZError as error:
        raise TransportError(f"cannot {what}: {error}") from None


def _answers(session: zenoh.Session, key: str, payload: bytes, timeout: float) -> list[bytes]:
    """Every answer to a query."""
    replies = session.get(
        key,
        payload=payload,
        timeout=timeout,
        target=zenoh.QueryTarget.ALL,
        consolidation=zenoh.ConsolidationMode.NONE,  # else one answer for each key, of all that serve it
    )
    return [reply.ok.payload.to_bytes() for reply in replies if reply.ok is not None]


class _ZenohRequest:
    """One query of Zenoh's; finalised as soon as it is answered or forgotten."""

    __slots__ = ("_buffers", "_query", "key", "size")

    def __init__(self, query: zenoh.Query, served: str) -> None:
        self._query: zenoh.Query | None = query
        self._buffers = query.payload
        self.key = served if "*" in str(query.key_expr) else str(query.key_expr)
        self.size = 0 if self._buffers is None else len(self._buffers)

    @property
    def payload(self) -> bytes:
        return b"" if self._buffers is None else self._buffers.to_bytes()

    def reply(self, payload: bytes) -> None:
        query, self._query = self._query, None
        if query is None:
            return
        try:
            query.reply(self.key, payload)
            query.drop()
        except zenoh.ZError:
            pass  # the asker is gone, or our own session is closing: nobody waits for this answer


class _ZenohInbox:
    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._newest: zenoh.ZBytes | None = None
        self.undeclare: Callable[[], None] = lambda: None

    def put(self, payload: zenoh.ZBytes) -> None:
        with self._lock:
            self._newest = payload

    def take(self) -> bytes | None:
        with self._lock:
            newest, self._newest = self._newest, None
        return None if newest is None else newest.to_bytes()

    def close(self) -> None:
        self.undeclare()


class _Callbacks:
    """Our functions that Zenoh holds, each on a thread of its own, which must be done with Python before that ends."""

    def __init__(self) -> None:
        self._changed = threading.Condition()
        self._held = 0

    def hold(self, function: Callable[[Any], None], at_end: Callable[[], None] = lambda: None) -> Any:
        """A callback as Zenoh takes them; `at_end` is called once, after the last call of `function`."""

        def drop() -> None:
            try:
                at_end()
            finally:
                with self._changed:
                    self._held -= 1
                    self._changed.notify_all()

        with self._changed:
            self._held += 1
        return zenoh.handlers.Callback(function, drop)

    def await_none(self) -> None:
        """Waits, within bounds, until Zenoh has let go of all of them."""
        with self._changed:
            self._changed.wait_for(lambda: not self._held, _LEAVING_SECONDS)


class ZenohTransport:
    """A Transport over one Zenoh session, and over another in its place where it was reopened."""

    def __init__(self, open_session: Callable[[], zenoh.Session], *, is_client: bool) -> None:
        """Opens its session; `open_session` raises TransportError if it cannot."""
        self._open_session = open_session
        self._is_client = is_client
        self._session = open_session()
        self._closed = False
        # What is to be made again in another session, and what it made in this one: that ends when it is garbage.
        self._declared: dict[Callable[[zenoh.Session], object], object] = {}
        self._queriers: dict[tuple[str, float], zenoh.Querier] = {}
        self._publishers: dict[str, zenoh.Publisher] = {}
        self._lock = threading.Lock()
        self._callbacks = _Callbacks()

    def serve(self, key: str, handler: Callable[[Request], None]) -> None:
        """See Transport."""

        def on_query(query: zenoh.Query) -> None:
            handler(_ZenohRequest(query, key))

        with _as_transport_error(f"serve {key}"):
            self._declare(lambda session: session.declare_queryable(key, self._callbacks.hold(on_query), complete=True))

    def _declare(self, declaration: Callable[[zenoh.Session], object]) -> None:
        self._declared[declaration] = declaration(self._session)

    def query(self, key: str, payload: bytes = b"", *, timeout: float) -> list[bytes]:
        """See Transport."""
        with _as_transport_error(f"ask {key}"):
            return _answers(self._session, key, payload, timeout)

    def query_async(self, key: str, payload: bytes, *, timeout: float, on_answer: OnAnswer) -> None:
        """See Transport."""
        first: list[bytes] = []

        def on_reply(reply: zenoh.Reply) -> None:
            if reply.ok is not None and not first:
                first.append(reply.ok.payload.to_bytes())

        def on_end() -> None:
            on_answer(first[0] if first else None)

        with _as_transport_error(f"send to {key}"):
            self._querier(key, timeout).get(self._callbacks.hold(on_reply, on_end), payload=payload)

    def _querier(self, key: str, timeout: float) -> zenoh.Querier:
        with self._lock:
            querier = self._queriers.get((key, timeout))
            if querier is None:
                querier = self._session.declare_querier(key, timeout=timeout, express=True)
                self._queriers[key, timeout] = querier
            return querier

    def publish(self, key: str, payload: bytes) -> None:
        """See Transport."""
        with _as_transport_error(f"publish {key}"):
            self._publisher(key).put(payload)

    def _publisher(self, key: str) -> zenoh.Publisher:
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

    def subscribe(self, key: str, on_news: Callable[[], None]) -> Inbox:
        """See Transport."""
        inbox = _ZenohInbox()

        def on_sample(sample: zenoh.Sample) -> None:
            inbox.put(sample.payload)
            on_news()

        def declaration(session: zenoh.Session) -> object:
            return session.declare_subscriber(key, self._callbacks.hold(on_sample))

        with _as_transport_error(f"follow {key}"):
            self._declare(declaration)
        inbox.undeclare = lambda: self._undeclare(declaration)
        return inbox

    def _undeclare(self, declaration: Callable[[zenoh.Session], object]) -> None:
        subscriber = self._declared.pop(declaration, None)
        if isinstance(subscriber, zenoh.Subscriber):
            with contextlib.suppress(zenoh.ZError):  # its session was closed: nothing comes any more anyway
                subscriber.undeclare()

    def declare_presence(self, key: str) -> None:
        """See Transport."""
        with _as_transport_error(f"announce {key}"):
            self._declare(lambda session: session.liveliness().declare_token(key))

    def watch_presence(self, key: str, on_change: Callable[[str, bool], None]) -> None:
        """See Transport."""
        present: set[str] = set()

        def on_sample(sample: zenoh.Sample) -> None:
            name, is_there = str(sample.key_expr), sample.kind == zenoh.SampleKind.PUT
            (present.add if is_there else present.discard)(name)
            on_change(name, is_there)

        def declaration(session: zenoh.Session) -> object:
            while present:  # as seen by a session that was given up: who is still there is told of again
                on_change(present.pop(), False)
            # Without history a token declared just after the subscriber is missed now and then.
            return session.liveliness().declare_subscriber(key, self._callbacks.hold(on_sample), history=True)

        with _as_transport_error(f"watch {key}"):
            self._declare(declaration)

    def reopen(self, unless_served: str | None = None) -> bool:
        """See Transport. A router that listens here is never reopened: it would refuse itself the address."""
        if not self._is_client:
            return False
        session = self._open_session()
        try:
            with _as_transport_error(f"ask {unless_served}"):
                unneeded = unless_served is not None and bool(_answers(session, unless_served, b"", _PROBE_SECONDS))
        except TransportError:
            session.close()
            raise
        with self._lock:
            if unneeded or self._closed:
                session.close()
                return False
            given_up, self._session = self._session, session
            self._queriers.clear()
            self._publishers.clear()
        given_up.close()
        with _as_transport_error("declare again"):
            self._declared = {declaration: declaration(session) for declaration in list(self._declared)}
        return True

    def close(self) -> None:
        """See Transport."""
        with self._lock:
            self._closed = True
            session = self._session
        if not session.is_closed():
            session.close()
            self._callbacks.await_none()
