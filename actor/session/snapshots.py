"""The newest snapshot of a learner: pushed to synchronous actors, fetched by all others, and when it is fetched."""

import math
import threading
import time
from collections.abc import Callable, Iterator

from daedalus.actor.errors import LearnerLostError
from daedalus.actor.session.conversation import LearnerQueries, RunEndWatch
from daedalus.protocol import keys
from daedalus.protocol.codec import ProtocolError, decode, encode
from daedalus.protocol.compact import Bits, bits_of, float32
from daedalus.protocol.limits import LEARNER_LIMITS, SNAPSHOT_PART_LIMITS
from daedalus.protocol.messages import (
    CompactSnapshot,
    Message,
    Refusal,
    RunEnded,
    Snapshot,
    SnapshotPart,
    SnapshotRequest,
    Welcome,
)
from daedalus.transport.interface import Inbox, Transport, TransportError

_PARTS_ANSWER_SECONDS = 60.0  # the learner compresses a snapshot first, and the link is slow
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
                timeout=_PARTS_ANSWER_SECONDS,
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


_ANSWER_SECONDS = 10.0  # the learner answers at once, but may drop the answer on a congested link


class SnapshotFetcher:
    """One actor's fetches from one learner epoch."""

    def __init__(
        self,
        transport: Transport,
        queries: LearnerQueries,
        run: str,
        actor: str,
        held_version: int,
        on_news: Callable[[], None],
    ) -> None:
        """`on_news` is called on the transport's threads when `take` has something new."""
        self._transport, self._queries, self._on_news = transport, queries, on_news
        self._key, self._actor, self._held_version = keys.snapshots(run), actor, held_version
        self._lock = threading.Lock()  # guards all below
        self._requested_at = 0.0
        self._fetching = False
        self._answer: bytes | None = None  # not taken yet
        self._seconds = 0.0
        self.answered_request_at = 0.0  # the monotonic time of the request that was answered last

    @property
    def requested_at(self) -> float:
        """The monotonic time of the last request."""
        return self._requested_at

    @property
    def seconds(self) -> float:
        """How long the last answer took."""
        return self._seconds

    @property
    def in_progress(self) -> bool:
        """Whether an answer is awaited."""
        return self._fetching

    def request_newest(self) -> None:
        """Request the newest snapshot, unless an answer is awaited."""
        with self._lock:
            if self._fetching:
                return
            self._fetching, self._requested_at = True, time.monotonic()
        request = SnapshotRequest(actor=self._actor, held_version=self._held_version, compact=False)
        try:
            self._transport.query_async(self._key, encode(request), timeout=_ANSWER_SECONDS, on_answer=self._on_answer)
        except TransportError:
            self._on_answer(None)

    def take(self) -> Message | None:
        """Return an answer of the learner that was not taken yet: a Snapshot, or another message."""
        with self._lock:
            answer, self._answer = self._answer, None
        message = None if answer is None else self._queries.decode(answer)
        if isinstance(message, Snapshot):
            self._held_version = message.policy_version
        return message

    def _on_answer(self, data: bytes | None) -> None:
        """Receive an answer, or None without one. Called on the transport's threads."""
        with self._lock:
            self._fetching = False
            if data is None:
                return
            self._answer, self._seconds = data, time.monotonic() - self._requested_at
            self.answered_request_at = self._requested_at
        self._on_news()


_SMALL_BYTES = 1 << 20  # of weights whose differences take the learner about a millisecond


class SnapshotFeed:
    """The snapshots of one learner after the other. For one thread.

    `on_news` is called on the transport's threads when `read` may have something new.
    """

    def __init__(
        self,
        transport: Transport,
        queries: LearnerQueries,
        end: RunEndWatch,
        actor: str,
        on_news: Callable[[], None],
    ) -> None:
        self._transport, self._queries, self._end, self._actor = transport, queries, end, actor
        self._on_news = on_news
        self._inboxes: dict[str, Inbox] = {}  # by run
        self._fetcher: SnapshotFetcher | CompactSnapshotFetcher | None = None
        self._fetches_on_request = False  # else snapshots are pushed, or fetched as often as a slow link allows
        self._run, self._learner_epoch = "", -1
        self.newest: Snapshot | None = None  # of this learner epoch
        self.confirmed_at = -math.inf  # the monotonic time at which `newest` was last known to be the learner's newest

    def begin(self, welcome: Welcome) -> None:
        """Begin with a learner: no snapshot of it is known, and nothing about its link."""
        self._run, self._learner_epoch, self.newest = welcome.run, welcome.learner_epoch, None
        self.confirmed_at = -math.inf
        self._fetcher, self._fetches_on_request = None, False

    def subscribe(self) -> None:
        """Receive every published snapshot from now on, unless compact snapshots are fetched. Idempotent."""
        if self._compact is None and self._run not in self._inboxes:
            self._inboxes[self._run] = self._transport.subscribe(keys.snapshots(self._run), self._on_news)

    def use_compact_snapshots(self) -> None:
        """End the subscription; from now on compact snapshots are fetched, as often as a slow link allows."""
        self._unsubscribe()
        self._fetches_on_request = False
        self._fetcher = CompactSnapshotFetcher(self._transport, self._run, self._actor, self._on_news)

    def use_differences(self) -> None:
        """Fetch compact snapshots, as differences, in place of whole ones from now on. Idempotent.

        Only of a small network: the learner computes the differences, which for a large one takes longer than to send
        the whole.
        """
        if not self._fetches_on_request or self._compact is not None or self.newest is None:
            return
        if sum(array.nbytes for array in self.newest.weights.values()) <= _SMALL_BYTES:
            self._fetcher = CompactSnapshotFetcher(self._transport, self._run, self._actor, self._on_news, rests=False)

    def use_fetches(self) -> None:
        """End the subscription; from now on whole snapshots are fetched on request, unless compact ones are.

        Call this when there is a snapshot.
        """
        if self._compact is None:
            self._unsubscribe()
            assert self.newest is not None
            self._fetcher, self._fetches_on_request = self._whole_fetcher(self.newest), True

    def _whole_fetcher(self, held: Snapshot) -> SnapshotFetcher:
        return SnapshotFetcher(
            self._transport, self._queries, self._run, self._actor, held.policy_version, self._on_news
        )

    def _unsubscribe(self) -> None:
        for inbox in self._inboxes.values():
            inbox.close()
        self._inboxes.clear()

    @property
    def _compact(self) -> CompactSnapshotFetcher | None:
        return self._fetcher if isinstance(self._fetcher, CompactSnapshotFetcher) else None

    @property
    def _scheduled(self) -> SnapshotFetcher | CompactSnapshotFetcher | None:
        """What fetches on request; None while snapshots are pushed, and on a slow link."""
        return self._fetcher if self._fetches_on_request else None

    @property
    def is_slow(self) -> bool:
        """Whether snapshots are fetched as often as a slow link allows."""
        return self._compact is not None and not self._fetches_on_request

    @property
    def fetch_seconds(self) -> float:
        """How long the last fetch on request took."""
        return 0.0 if self._scheduled is None else self._scheduled.seconds

    @property
    def fetched_at(self) -> float:
        """The monotonic time of the last fetch on request; never too long ago if there are none."""
        return math.inf if self._scheduled is None else self._scheduled.requested_at

    def read(self) -> None:
        """Decode what has come, and update `newest`. May take long: hold no lock meanwhile.

        Raises RunOverError if the run finished, LearnerLostError if the message is from another learner epoch.
        """
        for message, at in self._received():
            self._apply(message, at)

    def _received(self) -> Iterator[tuple[Message, float]]:
        """Yield each message that has come, with the monotonic time of its request; a push has the present time."""
        fetcher = self._fetcher
        message = None if fetcher is None else fetcher.take()
        if fetcher is not None and message is not None:
            yield message, fetcher.answered_request_at
        inbox = self._inboxes.get(self._run)
        data = None if inbox is None else inbox.take()
        message = None if data is None else self._queries.decode(data)
        if message is not None:
            yield message, time.monotonic()

    def is_current(self) -> bool:
        """Read what has come, and return whether no requested snapshot is awaited. Raises as `read` does."""
        awaited = self._scheduled is not None and self._scheduled.in_progress
        self.read()
        return not awaited

    def fetch(self) -> None:
        """Request the newest snapshot, if snapshots are fetched on request. Does not wait."""
        if self._scheduled is not None:
            self._scheduled.request_newest()

    def request_confirmation(self) -> None:
        """Ask whether `newest` is still the learner's newest, unless an answer is awaited. Does not wait."""
        if self._fetcher is None and self.newest is not None:
            self._fetcher = self._whole_fetcher(self.newest)
        if self._fetcher is not None:
            self._fetcher.request_newest()

    def request_newest(self) -> None:
        """Request the newest snapshot in case a push was lost. Raises as `read` does."""
        if self._compact is not None:
            self._compact.request_newest()
            return
        at = time.monotonic()
        for message in self._queries.newest_snapshot(self._run):
            self._apply(message, at)

    def request_compact_if_behind(self, newest_version: int) -> None:
        """Request the snapshot of a version that acknowledgements mention, on a slow link."""
        is_behind = self.newest is None or newest_version > self.newest.policy_version
        if self._fetcher is not None and self.is_slow and is_behind:
            self._fetcher.request_newest()

    def _apply(self, message: Message, at: float) -> None:
        """Apply a message; `at` is the monotonic time of the request that it answers, or at which it was pushed."""
        if isinstance(message, RunEnded):
            self._end.apply(message)
        if isinstance(message, Refusal) and self._compact is None:  # the learner has none that is newer
            self.confirmed_at = at
        if not isinstance(message, Snapshot):
            return
        if message.learner_epoch != self._learner_epoch:
            raise LearnerLostError
        if self.newest is None or message.policy_version > self.newest.policy_version:
            self.newest = message
        if message.policy_version == self.newest.policy_version:
            self.confirmed_at = at


_LEAST_PATIENCE, _MOST_PATIENCE = 0.1, 0.25  # of a wait for an answer, relative to the duration of a rollout
_FIRST_SECONDS = 1.0  # the expected duration of the first rollout


class FetchSchedule:
    """The schedule of one session. All times are monotonic, in seconds."""

    def __init__(self) -> None:
        self._began, self._rollout_seconds = 0.0, 0.0  # of the last rollout
        self._due_at = 0.0
        self._fetch_seconds = 0.0  # of the last fetch
        self._lead = 0.0  # how long before the end of a rollout the fetch is due
        self._asked_at, self._interval = 0.0, 0.0  # of calls of `is_due`

    def begin_rollout(self, now: float, fetch_seconds: float) -> None:
        """Note that a rollout begins, and how long the last fetch took."""
        self._began = self._asked_at = now
        self._fetch_seconds = fetch_seconds
        self._lead = fetch_seconds + self._interval
        expected = self._rollout_seconds or _FIRST_SECONDS
        self._due_at = now + max(expected - self._lead, 0.0)

    def is_due(self, now: float) -> bool:
        """Return whether to fetch now, in the course of a rollout. Call this often, such as before each row.

        True once as the rollout nears the duration of the one before, and again if it takes much longer.
        """
        self._interval, self._asked_at = now - self._asked_at, now
        if now < self._due_at:
            return False
        self._due_at = now + max(self._rollout_seconds, now - self._began)
        return True

    def end_rollout(self, now: float) -> None:
        """Note that the rollout is complete."""
        self._rollout_seconds = now - self._began

    @property
    def rollout_seconds(self) -> float:
        """Duration of the last rollout."""
        return self._rollout_seconds

    def is_stale(self, now: float, requested_at: float) -> bool:
        """Return whether a snapshot that was requested at a time is too old for a rollout that begins now."""
        return now > requested_at + self._lead + self.patience

    @property
    def patience(self) -> float:
        """The longest time for a rollout that is about to begin to wait for its snapshot."""
        least, most = _LEAST_PATIENCE * self._rollout_seconds, _MOST_PATIENCE * self._rollout_seconds
        return min(max(2.0 * self._fetch_seconds, least), most)
