"""Fetches compact snapshots part by part: over a slow link as often as it allows, else when they are asked for.

State and requests, no threads and no waiting. Answers arrive on the transport's threads, which request the next parts
at once: if `take` did that, each round trip would last as long as collecting a rollout.
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

_ANSWER_SECONDS = 60.0  # the learner compresses a snapshot first, and the link is slow
_PARALLEL_PARTS = 4  # requested at once: enough to fill a link of 4 Mbit/s whose answers take 200 ms
_MAX_PARTS = 1 << 15
_RETRY_SECONDS = 1.0  # after a failed fetch


class CompactSnapshotFetcher:
    """One actor's fetches from one learner epoch."""

    def __init__(
        self, transport: Transport, run: str, actor: str, on_news: Callable[[], None], *, rests: bool = True
    ) -> None:
        """Construct the fetcher.

        Args:
          transport, run, actor: where to fetch, and for whom.
          on_news: called on the transport's threads when `take` may have something new.
          rests: after a fetch let the link rest for as long as it took, because a slow link carries rollouts too.
        """
        self._rests = rests
        self._transport, self._on_news = transport, on_news
        self._key, self._actor = keys.snapshots(run), actor
        self._held: tuple[int, Bits] | None = None  # the version and weights that differences are added to
        self._lock = threading.Lock()  # guards all below
        self._fetch = 0  # the number of the current fetch; answers to earlier fetches are ignored
        self._parts: dict[int, bytes] = {}  # of the current fetch, received so far
        self._bytes = 0  # of these parts together
        self._count = 0  # of its parts; 0 before it is known
        self._requested = 0  # how many of its parts were requested
        self._version: int | None = None
        self._fetching = False
        self._fetched: bytes | Message | None = None  # an encoded CompactSnapshot, or another answer of the learner
        self._began = self._next_at = self._seconds = 0.0
        self.answered_request_at = 0.0  # the monotonic time of the fetch that ended last

    @property
    def requested_at(self) -> float:
        """The monotonic time of the last request for the newest snapshot."""
        return self._began

    @property
    def seconds(self) -> float:
        """How long the last fetch took."""
        return self._seconds

    @property
    def in_progress(self) -> bool:
        """Whether a snapshot is awaited."""
        return self._fetching

    def request_newest(self) -> None:
        """Begin to fetch the newest snapshot, unless a fetch is in progress or the link must rest."""
        with self._lock:
            if self._fetching or self._fetched is not None or time.monotonic() < self._next_at:
                return
            self._fetch += 1
            self._fetching, self._requested, self._version = True, 1, None
            self._parts, self._count, self._bytes = {}, 0, 0
            self._began = time.monotonic()
        self._request(self._fetch, 0, None)

    def take(self) -> Message | None:
        """Return a Snapshot once all its parts have come, another answer of the learner, or None before either."""
        with self._lock:
            fetched, self._fetched = self._fetched, None
        if not isinstance(fetched, bytes):
            return fetched
        snapshot = self._assemble(fetched)
        if snapshot is None:
            with self._lock:
                self._next_at = time.monotonic() + _RETRY_SECONDS
        return snapshot

    def _request(self, fetch: int, part: int, version: int | None) -> None:
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
        """Receive an answer, or None without one. Called on the transport's threads."""
        try:
            message = None if data is None else decode(data, SNAPSHOT_PART_LIMITS)
        except ProtocolError:
            message = None
        with self._lock:
            parts, version = self._accept(fetch, message), self._version
        for part in parts:
            self._request(fetch, part, version)
        self._on_news()

    def _accept(self, fetch: int, message: Message | None) -> range:
        """Store an answer, and return the parts to request now. The lock is held."""
        none = range(0)
        if fetch != self._fetch or not self._fetching:
            return none
        if not isinstance(message, SnapshotPart):
            self._end(message, rest=_RETRY_SECONDS)
            return none
        if not self._count:
            self._count, self._version = message.parts, message.policy_version
        self._bytes += message.data.size
        if (
            (message.parts, message.policy_version) != (self._count, self._version)
            or self._count > _MAX_PARTS
            or self._bytes > LEARNER_LIMITS.message_bytes
            or message.part in self._parts
        ):
            self._end(None, rest=_RETRY_SECONDS)
            return none
        self._parts[message.part] = message.data.tobytes()
        if len(self._parts) == self._count:
            whole = b"".join(self._parts[part] for part in range(self._count))
            self._seconds = time.monotonic() - self._began
            self._end(whole, rest=self._seconds if self._rests else 0.0)
            return none
        first, self._requested = self._requested, min(self._count, len(self._parts) + _PARALLEL_PARTS)
        return range(first, self._requested)

    def _assemble(self, encoded: bytes) -> Snapshot | None:
        """Return the snapshot that the joined parts encode, or None if they encode none."""
        try:
            message = decode(encoded, LEARNER_LIMITS)
        except ProtocolError:
            self._held = None  # the next fetch is of whole weights
            return None
        if not isinstance(message, CompactSnapshot):
            return None
        base = None
        if message.base_version is not None:
            if self._held is None or self._held[0] != message.base_version:
                return None
            base = self._held[1]
        try:
            bits = bits_of(message.weights, base)
        except ValueError:  # the learner's fault: the weights do not fit those held
            self._held = None
            return None
        self._held = message.policy_version, bits
        return Snapshot(
            learner_epoch=message.learner_epoch,
            policy_version=message.policy_version,
            program=message.program,
            weights=float32(bits),
        )

    def _end(self, fetched: bytes | Message | None, *, rest: float) -> None:
        self._fetching, self._count, self._parts, self._fetched = False, 0, {}, fetched
        self._next_at, self.answered_request_at = time.monotonic() + rest, self._began
