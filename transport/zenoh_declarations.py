"""What Zenoh holds of ours and gives to us: callbacks, declarations, queries, values and presence, and its senders."""

import contextlib
import threading
from collections.abc import Callable
from typing import Any, ParamSpec, Protocol

import zenoh

from daedalus.protocol import keys

Parameters = ParamSpec("Parameters")


def report_exceptions(function: Callable[Parameters, Any]) -> Callable[Parameters, None]:
    """Return `function` with every exception passed to `threading.excepthook`, and without a return value.

    A library that calls a callback on a thread of its own may swallow what the callback raises. An exception there is
    a fault of ours, just as in a `threading.Thread`; the commands install a hook that ends the process.
    """

    def call(*args: Parameters.args, **kwargs: Parameters.kwargs) -> None:
        try:
            function(*args, **kwargs)
        except BaseException as error:  # as threading.Thread does
            details = type(error), error, error.__traceback__, threading.current_thread()
            threading.excepthook(threading.ExceptHookArgs(details))

    return call


_RELEASE_SECONDS = 2.0  # for Zenoh to release callbacks when a session is closed


class Callbacks:
    """The callbacks of a transport: counts them until Zenoh has released them, and reports what they raise.

    Zenoh would log an exception of a callback and carry on. A process that ends while Zenoh's threads still hold
    callbacks aborts now and then, so a transport waits for their release when it closes.
    """

    def __init__(self) -> None:
        self._changed = threading.Condition()
        self._held = 0

    def hold(self, function: Callable[[Any], None], at_end: Callable[[], None] = lambda: None) -> Any:
        """Return `function` as the callback that Zenoh takes.

        `at_end` is called once, after the last call of `function`. Exceptions of both reach `threading.excepthook`.
        """
        report_end = report_exceptions(at_end)

        def drop() -> None:
            try:
                report_end()
            finally:
                with self._changed:
                    self._held -= 1
                    self._changed.notify_all()

        with self._changed:
            self._held += 1
        return zenoh.handlers.Callback(report_exceptions(function), drop)

    def await_release(self) -> None:
        """Wait until Zenoh has released all callbacks, for 2 seconds at most."""
        with self._changed:
            self._changed.wait_for(lambda: not self._held, _RELEASE_SECONDS)


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


class Declared(Protocol):
    """What Zenoh returns for a declaration; Zenoh undeclares it when it is garbage-collected."""

    def undeclare(self) -> Any:
        """Withdraw the declaration."""
        ...


Declare = Callable[[zenoh.Session], Declared]  # makes one declaration in a session


class Declarations:
    """The declarations of a transport, each of them made once in the present session. Safe to use from several threads.

    The lock is never held during a call into Zenoh: a call over a dead connection may take long, and the function of a
    declaration may call back.
    """

    def __init__(self, session: zenoh.Session) -> None:
        """Construct without declarations; `session` is the present session."""
        self._lock = threading.Lock()  # guards all below
        self._session = session
        self._declared: dict[Declare, Declared | None] = {}  # None: it is being declared in the present session

    def add(self, declare: Declare) -> None:
        """Declare in the present session, and in those that replace it. Raises ZError if the session refuses."""
        with self._lock:
            session = self._session
            self._declared[declare] = None
        try:
            self._make(declare, session)
        except zenoh.ZError:
            self.remove(declare)
            raise

    def remove(self, declare: Declare) -> None:
        """Withdraw a declaration. Idempotent."""
        with self._lock:
            declared = self._declared.pop(declare, None)
        if declared is not None:
            _undeclare(declared)

    def move_to(self, session: zenoh.Session) -> None:
        """Close the present session and repeat the declarations in another. Raises ZError if that session refuses."""
        with self._lock:
            previous, self._session = self._session, session
            replaced, self._declared = self._declared, dict.fromkeys(self._declared)
            to_repeat = list(self._declared)
        previous.close()
        replaced.clear()  # garbage of a closed session, which is undeclared without any message
        for declare in to_repeat:
            self._make(declare, session)

    def _make(self, declare: Declare, session: zenoh.Session) -> None:
        """Declare in a session; undo it if the declaration was withdrawn, or the session replaced, meanwhile."""
        try:
            declared = declare(session)
        except zenoh.ZError:
            with self._lock:
                if self._session is not session:
                    return  # `move_to` makes the declaration in the session that followed
            raise
        with self._lock:
            is_current = self._session is session and declare in self._declared
            if is_current:
                self._declared[declare] = declared
        if not is_current:
            _undeclare(declared)


def _undeclare(declared: Declared) -> None:
    with contextlib.suppress(zenoh.ZError):  # its session was closed, and the declaration with it
        declared.undeclare()
