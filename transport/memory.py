"""A Transport within one process: for tests, and for an actor and a learner in one program."""

import threading
import time
from collections.abc import Callable
from functools import partial

from daedalus.protocol import keys
from daedalus.transport.interface import Declaration, Inbox, OnAnswer, Request


class _MemoryRequest:
    """A query within the process; passes None to `on_answer` if it is garbage-collected without an answer."""

    def __init__(self, key: str, payload: bytes, on_answer: Callable[[bytes | None], None]) -> None:
        self.key, self.payload, self.size = key, payload, len(payload)
        self._on_answer: Callable[[bytes | None], None] | None = on_answer

    def reply(self, payload: bytes) -> None:
        self._answer(payload)

    def __del__(self) -> None:
        self._answer(None)  # the server dropped it without an answer

    def _answer(self, payload: bytes | None) -> None:
        on_answer, self._on_answer = self._on_answer, None
        if on_answer is not None:
            on_answer(payload)


class _MemoryInbox:
    """The newest unread value of one subscription."""

    def __init__(self, key: str, on_news: Callable[[], None]) -> None:
        self.key, self.on_news, self.newest = key, on_news, None

    def put(self, payload: bytes) -> None:
        self.newest: bytes | None = payload
        self.on_news()

    def take(self) -> bytes | None:
        newest, self.newest = self.newest, None
        return newest

    def close(self) -> None:
        self.key = ""


class _MemoryPresence:
    """A declared presence."""

    def __init__(self, withdraw: Callable[[], None]) -> None:
        self._withdraw = withdraw

    def close(self) -> None:
        self._withdraw()


class MemoryNetwork:
    """The MemoryTransports that reach each other."""

    def __init__(self) -> None:
        self.lock = threading.RLock()
        self.ends: list[MemoryTransport] = []


def matches(pattern: str, key: str) -> bool:
    """Return whether two keys match; `*` on either side stands for one chunk."""
    left, right = pattern.split("/"), key.split("/")
    return len(left) == len(right) and all(a == b or "*" in (a, b) for a, b in zip(left, right, strict=True))


class MemoryTransport:
    """A Transport within one process, without sockets; handlers run on the caller's thread."""

    def __init__(self, network: MemoryNetwork) -> None:
        self._network = network
        self._served: dict[str, Callable[[Request], None]] = {}
        self._inboxes: list[_MemoryInbox] = []
        self._present_keys: set[str] = set()
        self._watches: list[tuple[str, Callable[[str, bool], None]]] = []
        with network.lock:
            network.ends.append(self)

    @property
    def local_address(self) -> str:
        """See Transport."""
        return "memory"

    def _ends(self) -> list["MemoryTransport"]:
        with self._network.lock:
            return list(self._network.ends)

    def serve(self, key: str, handler: Callable[[Request], None]) -> None:
        """See Transport."""
        self._served[key] = handler

    def query(self, key: str, payload: bytes = b"", *, timeout: float) -> list[bytes]:
        """See Transport."""
        return [answer for _, answer in self.query_by_key(key, payload, timeout=timeout)]

    def query_by_key(self, key: str, payload: bytes = b"", *, timeout: float) -> list[tuple[str, bytes]]:
        """See Transport."""
        answers: list[tuple[str, bytes]] = []
        answered = threading.Semaphore(0)

        def on_answer(served: str, answer: bytes | None) -> None:
            if answer is not None:
                answers.append((served, answer))
            answered.release()

        handlers = self._handlers(key)
        for served, handler in handlers:
            handler(_MemoryRequest(served, payload, partial(on_answer, served)))
        deadline = time.monotonic() + timeout
        for _ in handlers:
            answered.acquire(timeout=max(deadline - time.monotonic(), 0.0))
        return list(answers)

    def query_async(self, key: str, payload: bytes, *, timeout: float, on_answer: OnAnswer) -> None:
        """See Transport. `timeout` has no effect: within a process no answer is lost."""
        handlers = self._handlers(key)
        if not handlers:
            on_answer(None)
        for served, handler in handlers[:1]:
            handler(_MemoryRequest(served, payload, on_answer))

    def _handlers(self, key: str) -> list[tuple[str, Callable[[Request], None]]]:
        return [
            (keys.intersection(served, key), handler)
            for end in self._ends()
            for served, handler in end._served.items()
            if matches(served, key)
        ]

    def publish(self, key: str, payload: bytes) -> None:
        """See Transport."""
        for end in self._ends():
            for inbox in end._inboxes:
                if matches(inbox.key, key):
                    inbox.put(payload)

    def subscribe(self, key: str, on_news: Callable[[], None]) -> Inbox:
        """See Transport."""
        inbox = _MemoryInbox(key, on_news)
        self._inboxes.append(inbox)
        return inbox

    def declare_presence(self, key: str) -> Declaration:
        """See Transport."""
        self._present_keys.add(key)
        self._report(key, True)
        return _MemoryPresence(lambda: self._withdraw(key))

    def _withdraw(self, key: str) -> None:
        if key in self._present_keys:
            self._present_keys.remove(key)
            self._report_if_gone(key)

    def _report_if_gone(self, key: str) -> None:
        if not any(key in end._present_keys for end in self._ends()):
            self._report(key, False)

    def watch_presence(self, key: str, on_change: Callable[[str, bool], None]) -> None:
        """See Transport."""
        self._watches.append((key, on_change))
        for end in self._ends():
            for declared in list(end._present_keys):
                if matches(key, declared):
                    on_change(declared, True)

    def present(self, key: str) -> list[str]:
        """See Transport."""
        return sorted({declared for end in self._ends() for declared in end._present_keys if matches(key, declared)})

    def _report(self, key: str, present: bool) -> None:
        for end in self._ends():
            for pattern, on_change in end._watches:
                if matches(pattern, key):
                    on_change(key, present)

    def reopen(self, unless_served: str | None = None) -> bool:
        """See Transport. Always False: there is no session that could die."""
        return False

    def close(self) -> None:
        """See Transport."""
        with self._network.lock:
            if self not in self._network.ends:
                return
            self._network.ends.remove(self)
        for key in self._present_keys:
            self._report_if_gone(key)
