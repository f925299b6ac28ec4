"""The Transport over Zenoh: the only file that imports it.

A session either embeds a full router that listens (the learner, by default) or is a client of one.
Multicast and gossip are off, endpoints are explicit, nothing is sent over shared memory.

What Zenoh needs to be held to (measured, see docs/results.md):
  - BLOCK is not flow control: a peer that stalls is disconnected with all it had. So rollouts are
    queries that are answered, and snapshots are put with DROP.
  - A process that ends with a callback declared and its session open hangs for ever: `close` belongs
    in a `finally`.
  - A router waits half a second for peers it could scout before it opens, unless told not to.
"""

import contextlib
import json
import threading
from collections.abc import Callable, Iterator

import zenoh

from protocol.transport import AddressInUseError, Inbox, Request, Transport, TransportError

_LEASE_MILLISECONDS = 2000  # a peer that is silent for as long is gone
_RETRY_MILLISECONDS = 100  # how soon a client tries again after its router vanished; doubles up to ten times this


def listen(endpoints: list[str], connect: list[str] | None = None) -> Transport:
    """Opens a router that listens on `endpoints` (`tcp/HOST:PORT`) and may join other routers.

    Raises AddressInUseError or TransportError.
    """
    return _open("router", endpoints, connect or [])


def connect(endpoints: list[str]) -> Transport:
    """Opens a client of the router at one of `endpoints`.

    Raises TransportError at once if none of them can be reached.
    """
    return _open("client", [], endpoints)


def _open(mode: str, listen_on: list[str], connect_to: list[str]) -> "ZenohTransport":
    config = zenoh.Config()
    settings = {
        "mode": mode,
        "listen/endpoints": listen_on,
        "connect/endpoints": connect_to,
        "connect/timeout_ms": 0,
        "connect/exit_on_failure": mode == "client",
        "connect/retry": {
            "period_init_ms": _RETRY_MILLISECONDS,
            "period_max_ms": 10 * _RETRY_MILLISECONDS,
            "period_increase_factor": 2,
        },
        "scouting/multicast/enabled": False,
        "scouting/gossip/enabled": False,
        "scouting/delay": 0,
        "transport/link/tx/lease": _LEASE_MILLISECONDS,
        "transport/shared_memory/enabled": False,
    }
    try:
        for name, value in settings.items():
            config.insert_json5(name, json.dumps(value))
        session = zenoh.open(config)
    except zenoh.ZError as error:
        raise _opening_error(str(error), listen_on, connect_to) from None
    return ZenohTransport(session)


def _opening_error(text: str, listen_on: list[str], connect_to: list[str]) -> TransportError:
    if "in use" in text:
        return AddressInUseError(
            f"address {', '.join(listen_on)} is already in use: "
            "stop what listens there, or choose another with --listen"
        )
    if connect_to:
        return TransportError(f"nothing answers at {', '.join(connect_to)}")
    return TransportError(f"cannot listen on {', '.join(listen_on)}: {text.splitlines()[0][:200]}")


@contextlib.contextmanager
def _as_transport_error(what: str) -> Iterator[None]:
    try:
        yield
    except zenoh.ZError as error:
        raise TransportError(f"cannot {what}: {error}") from None


class _ZenohRequest:
    """One query of Zenoh's; finalised as soon as it is answered or forgotten."""

    __slots__ = ("_query", "key", "payload")

    def __init__(self, query: zenoh.Query, served: str) -> None:
        self._query: zenoh.Query | None = query
        self.key = served if "*" in str(query.key_expr) else str(query.key_expr)
        self.payload = query.payload.to_bytes() if query.payload is not None else b""

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

    def put(self, payload: zenoh.ZBytes) -> None:
        with self._lock:
            self._newest = payload

    def take(self) -> bytes | None:
        with self._lock:
            newest, self._newest = self._newest, None
        return None if newest is None else newest.to_bytes()


class ZenohTransport:
    """A Transport over one Zenoh session."""

    def __init__(self, session: zenoh.Session) -> None:
        self._session = session
        self._declared: list[object] = []  # tokens and watches end when they are garbage
        self._queriers: dict[tuple[str, float], zenoh.Querier] = {}
        self._publishers: dict[str, zenoh.Publisher] = {}
        self._lock = threading.Lock()

    def serve(self, key: str, handler: Callable[[Request], None]) -> None:
        """See Transport."""
        with _as_transport_error(f"serve {key}"):
            self._declared.append(
                self._session.declare_queryable(key, lambda query: handler(_ZenohRequest(query, key)), complete=True)
            )

    def ask(self, key: str, payload: bytes = b"", *, timeout: float) -> list[bytes]:
        """See Transport."""
        with _as_transport_error(f"ask {key}"):
            replies = self._session.get(
                key,
                payload=payload,
                timeout=timeout,
                target=zenoh.QueryTarget.ALL,
                consolidation=zenoh.ConsolidationMode.NONE,  # else one answer for each key, of all that serve it
            )
            return [reply.ok.payload.to_bytes() for reply in replies if reply.ok is not None]

    def send(self, key: str, payload: bytes, *, timeout: float, on_answer: Callable[[bytes | None], None]) -> None:
        """See Transport."""
        first: list[bytes] = []

        def on_reply(reply: zenoh.Reply) -> None:
            if reply.ok is not None and not first:
                first.append(reply.ok.payload.to_bytes())

        def on_end() -> None:
            on_answer(first[0] if first else None)

        with _as_transport_error(f"send to {key}"):
            self._querier(key, timeout).get(zenoh.handlers.Callback(on_reply, on_end), payload=payload)

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

    def follow(self, key: str, on_news: Callable[[], None]) -> Inbox:
        """See Transport."""
        inbox = _ZenohInbox()

        def on_sample(sample: zenoh.Sample) -> None:
            inbox.put(sample.payload)
            on_news()

        with _as_transport_error(f"follow {key}"):
            self._declared.append(self._session.declare_subscriber(key, on_sample))
        return inbox

    def announce(self, key: str) -> None:
        """See Transport."""
        with _as_transport_error(f"announce {key}"):
            self._declared.append(self._session.liveliness().declare_token(key))

    def watch(self, key: str, on_change: Callable[[str, bool], None]) -> None:
        """See Transport."""

        def on_sample(sample: zenoh.Sample) -> None:
            on_change(str(sample.key_expr), sample.kind == zenoh.SampleKind.PUT)

        with _as_transport_error(f"watch {key}"):
            # Without history a token declared just after the subscriber is missed now and then.
            self._declared.append(self._session.liveliness().declare_subscriber(key, on_sample, history=True))

    def close(self) -> None:
        """See Transport."""
        if not self._session.is_closed():
            self._session.close()
