"""What one transport has declared to Zenoh, in one session after the other. State with a lock, without threads."""

import contextlib
import threading
from collections.abc import Callable
from typing import Any, Protocol

import zenoh


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
