"""Fetches snapshots over a link that does not carry every one whole: compact ones, part by part, as often as it bears.

State and requests, no threads and no waiting: answers arrive on the transport's threads, which ask for the next parts
at once. Were that left to `take`, each round trip would last as long as a rollout is played.
"""

import threading
import time
from collections.abc import Callable

from daedalus.protocol import keys
from daedalus.protocol.codec import ProtocolError, decode, encode
from daedalus.protocol.compact import Bits, bits_of, float32
from daedalus.protocol.limits import LEARNER_LIMITS, SNAPSHOT_PART_LIMITS
from daedalus.protocol.messages import CompactSnapshot, Message, Snapshot, SnapshotPart, SnapshotRequest
from daedalus.transport.interface import Transport, TransportError

_ANSWER_SECONDS = 60.0  # the learner makes a snapshot small first, and the link takes its time
_AT_ONCE = 4  # parts under way: enough to fill a link of 4 Mbit/s whose answers take 200 ms
_MOST_PARTS = 1 << 15
_RETRY_SECONDS = 1.0  # after a fetch that failed


class CompactSnapshotFetcher:
    """One actor's fetches from one life of a learner."""

    def __init__(self, transport: Transport, run: str, actor: str, on_news: Callable[[], None]) -> None:
        self._transport, self._on_news = transport, on_news
        self._key, self._actor = keys.snapshots(run), actor
        self._held: tuple[int, Bits] | None = None
        self._lock = threading.Lock()  # guards all below
        self._fetch = 0  # numbers them: late answers to one that was given up count for nothing
        self._parts: dict[int, bytes] = {}  # that have come, of the fetch under way
        self._count = 0  # of its parts; 0 before it is known
        self._asked = 0
        self._version: int | None = None
        self._busy = False
        self._brought: bytes | Message | None = None  # by the last fetch: a whole CompactSnapshot, or what came instead
        self._began = self._next_at = 0.0

    def want(self) -> None:
        """Has the newest snapshot fetched, unless a fetch is under way, or the link deserves a rest.

        It rests for as long as the last fetch took: rollouts and their answers want to pass too.
        """
        with self._lock:
            if self._busy or self._brought is not None or time.monotonic() < self._next_at:
                return
            self._fetch += 1
            self._busy, self._parts, self._count, self._version, self._asked = True, {}, 0, None, 1
            self._began = time.monotonic()
        self._ask(self._fetch, 0, None)

    def take(self) -> Message | None:
        """A Snapshot, once all its parts have come; or what a learner says instead of a part; or nothing yet."""
        with self._lock:
            brought, self._brought = self._brought, None
        if not isinstance(brought, bytes):
            return brought
        snapshot = self._assembled(brought)
        if snapshot is None:
            with self._lock:
                self._next_at = time.monotonic() + _RETRY_SECONDS
        return snapshot

    def _ask(self, fetch: int, part: int, version: int | None) -> None:
        held = None if self._held is None else self._held[0]
        request = SnapshotRequest(actor=self._actor, held_version=held, policy_version=version, part=part)
        try:
            self._transport.query_async(
                self._key,
                encode(request),
                timeout=_ANSWER_SECONDS,
                on_answer=lambda answer: self._on_answer(fetch, answer),
            )
        except TransportError:
            self._on_answer(fetch, None)

    def _on_answer(self, fetch: int, data: bytes | None) -> None:
        with self._lock:
            parts, version = self._due_after(fetch, data), self._version
        for part in parts:
            self._ask(fetch, part, version)
        self._on_news()

    def _due_after(self, fetch: int, data: bytes | None) -> range:
        """Keeps what an answer brought; the parts to ask for now."""
        none = range(0)
        if fetch != self._fetch or not self._busy:
            return none
        try:
            message = None if data is None else decode(data, SNAPSHOT_PART_LIMITS)
        except ProtocolError:
            message = None
        if not isinstance(message, SnapshotPart):
            self._end(message, rest=_RETRY_SECONDS)
            return none
        if not self._count:
            self._count, self._version = message.parts, message.policy_version
        if (message.parts, message.policy_version) != (self._count, self._version) or self._count > _MOST_PARTS:
            self._end(None, rest=_RETRY_SECONDS)
            return none
        self._parts[message.part] = message.data.tobytes()
        if len(self._parts) == self._count:
            whole = b"".join(self._parts[part] for part in range(self._count))
            self._end(whole, rest=time.monotonic() - self._began)
            return none
        first, self._asked = self._asked, min(self._count, len(self._parts) + _AT_ONCE)
        return range(first, self._asked)

    def _assembled(self, encoded: bytes) -> Snapshot | None:
        """The snapshot that all the parts make; None if they make none."""
        try:
            message = decode(encoded, LEARNER_LIMITS)
            if not isinstance(message, CompactSnapshot):
                return None
            base = None
            if message.base_version is not None:
                if self._held is None or self._held[0] != message.base_version:
                    return None
                base = self._held[1]
            bits = bits_of(message.weights, base)
        except (ProtocolError, ValueError):
            self._held = None  # begin anew, with a whole one
            return None
        self._held = message.policy_version, bits
        return Snapshot(
            learner_epoch=message.learner_epoch,
            policy_version=message.policy_version,
            program=message.program,
            weights=float32(bits),
        )

    def _end(self, brought: bytes | Message | None, *, rest: float) -> None:
        self._busy, self._count, self._parts, self._brought = False, 0, {}, brought
        self._next_at = time.monotonic() + rest
