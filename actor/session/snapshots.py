"""The newest snapshot of a learner: pushed to synchronous actors, fetched by all others, and when it is fetched.

State without threads, I/O or clock: parts of a Conversation.
"""

import contextlib
import math
from functools import partial

from daedalus.actor.errors import LearnerLostError
from daedalus.actor.session.conversation import Conversation, Query, Steps, Subscribe, Unsubscribe, Work
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
)

_ANSWER_SECONDS = 10.0  # the learner answers at once, but may drop the answer on a congested link
_PARTS_ANSWER_SECONDS = 60.0  # the learner compresses a snapshot first, and the link is slow
_PARALLEL_PARTS = 4  # requested at once: enough to fill a link of 4 Mbit/s whose answers take 200 ms
_MAX_PARTS = 1 << 15
_RETRY_SECONDS = 1.0  # after a failed fetch
_SMALL_BYTES = 1 << 20  # of weights whose differences take the learner about a millisecond
_LEAST_PATIENCE, _MOST_PATIENCE = 0.1, 0.25  # of a wait for an answer, relative to the duration of a rollout
_FIRST_SECONDS = 1.0  # the expected duration of the first rollout


class SnapshotFetcher:
    """Fetches of whole snapshots from one learner epoch, one at a time.

    Attributes:
      in_progress: whether an answer is awaited.
      requested_at: the time of the last request; `answered_request_at`: of the last one that was answered.
      seconds: how long the last answer took.
    """

    def __init__(self, conversation: Conversation, held_version: int) -> None:
        self._conversation, self._held_version = conversation, held_version
        self.in_progress = False
        self.requested_at = self.answered_request_at = self.seconds = 0.0
        self._answer: bytes | None = None  # not taken yet

    def request_newest(self) -> None:
        """Request the newest snapshot, unless an answer is awaited."""
        if self.in_progress:
            return
        talk = self._conversation
        self.in_progress, self.requested_at = True, talk.now
        request = SnapshotRequest(actor=talk.join.actor, held_version=self._held_version, compact=False)
        talk.act(Query(keys.snapshots(talk.run), encode(request), _ANSWER_SECONDS, self._on_answer))

    def take(self) -> Steps[Message | None]:
        """Return an answer of the learner that was not taken yet: a Snapshot, or another message."""
        answer, self._answer = self._answer, None
        message = None if answer is None else (yield Work(partial(self._conversation.decode, answer)))
        if isinstance(message, Snapshot):
            self._held_version = message.policy_version
        return message

    def _on_answer(self, data: bytes | None, now: float) -> None:
        self.in_progress = False
        if data is not None:
            self._answer, self.seconds, self.answered_request_at = data, now - self.requested_at, self.requested_at
            self._conversation.heard(now)


class CompactSnapshotFetcher:
    """Fetches of compact snapshots, part by part, from one learner epoch. Attributes: see SnapshotFetcher.

    Each answer requests the next parts at once: if `take` did that, each round trip would last as long as collecting a
    rollout.
    """

    def __init__(self, conversation: Conversation, *, rests: bool = True) -> None:
        """`rests`: after a fetch let the link rest for as long as it took: a slow link carries rollouts too."""
        self._conversation, self._rests = conversation, rests
        self._held: tuple[int, Bits] | None = None  # the version and weights that differences are added to
        self.in_progress = False
        self.requested_at = self.answered_request_at = self.seconds = 0.0
        self._next_at = 0.0
        self._fetch = 0  # the number of the current fetch; answers to earlier fetches are ignored
        self._parts: dict[int, bytes] = {}  # of the current fetch, received so far
        self._bytes = 0  # of these parts together
        self._count = 0  # of its parts; 0 before it is known
        self._requested = 0  # how many of its parts were requested
        self._version: int | None = None
        self._fetched: bytes | Message | None = None  # an encoded CompactSnapshot, or another answer of the learner

    def request_newest(self) -> None:
        """Begin to fetch the newest snapshot, unless a fetch is in progress or the link must rest."""
        now = self._conversation.now
        if self.in_progress or self._fetched is not None or now < self._next_at:
            return
        self._fetch += 1
        self.in_progress, self._requested, self._version = True, 1, None
        self._parts, self._count, self._bytes = {}, 0, 0
        self.requested_at = now
        self._request(0)

    def take(self) -> Steps[Message | None]:
        """Return a Snapshot once all its parts have come, another answer of the learner, or None before either."""
        fetched, self._fetched = self._fetched, None
        if not isinstance(fetched, bytes):
            return fetched
        snapshot = yield Work(partial(self._assemble, fetched))
        if snapshot is None:
            self._next_at = self._conversation.now + _RETRY_SECONDS
        return snapshot

    def _request(self, part: int) -> None:
        talk, held = self._conversation, None if self._held is None else self._held[0]
        request = SnapshotRequest(actor=talk.join.actor, held_version=held, policy_version=self._version, part=part)
        on_answer = partial(self._on_answer, self._fetch)
        talk.act(Query(keys.snapshots(talk.run), encode(request), _PARTS_ANSWER_SECONDS, on_answer))

    def _on_answer(self, fetch: int, data: bytes | None, now: float) -> None:
        message = None
        if data is not None:
            self._conversation.heard(now)
            with contextlib.suppress(ProtocolError):
                message = decode(data, SNAPSHOT_PART_LIMITS)
        if fetch == self._fetch and self.in_progress:
            self._accept(message, now)

    def _accept(self, message: Message | None, now: float) -> None:
        """Store an answer, and request the parts that may be requested now."""
        if not isinstance(message, SnapshotPart):
            self._end(message, now + _RETRY_SECONDS)
            return
        if not self._count:
            self._count, self._version = message.parts, message.policy_version
        self._bytes += message.data.size
        if (
            (message.parts, message.policy_version) != (self._count, self._version)
            or self._count > _MAX_PARTS
            or self._bytes > LEARNER_LIMITS.message_bytes
            or message.part in self._parts
        ):
            self._end(None, now + _RETRY_SECONDS)
            return
        self._parts[message.part] = message.data.tobytes()
        if len(self._parts) == self._count:
            whole = b"".join(self._parts[part] for part in range(self._count))
            self.seconds = now - self.requested_at
            self._end(whole, now + (self.seconds if self._rests else 0.0))
            return
        first, self._requested = self._requested, min(self._count, len(self._parts) + _PARALLEL_PARTS)
        for part in range(first, self._requested):
            self._request(part)

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
            lessons=message.lessons,
        )

    def _end(self, fetched: bytes | Message | None, next_at: float) -> None:
        self.in_progress, self._count, self._parts, self._fetched = False, 0, {}, fetched
        self._next_at, self.answered_request_at = next_at, self.requested_at


class SnapshotFeed:
    """The snapshots of one learner after the other, as pushed or fetched.

    Attributes:
      newest: snapshot of this learner epoch, or None before the first.
      confirmed_at: the time at which `newest` was last known to be the learner's newest.
    """

    def __init__(self, conversation: Conversation) -> None:
        self._conversation = conversation
        self._subscribed = ""  # the key of the subscription; an empty text without one
        self._pushed: bytes | None = None  # not read yet
        self._fetcher: SnapshotFetcher | CompactSnapshotFetcher | None = None
        self._fetches_on_request = False  # else snapshots are pushed, or fetched as often as a slow link allows
        self.newest: Snapshot | None = None
        self.confirmed_at = -math.inf

    def begin(self) -> None:
        """Begin with a learner: no snapshot of it is known, and nothing about its link."""
        self.newest, self.confirmed_at, self._pushed = None, -math.inf, None
        self._fetcher, self._fetches_on_request = None, False

    def received(self, key: str, data: bytes, now: float) -> None:
        """Receive a value that was pushed."""
        if key == self._subscribed == keys.snapshots(self._conversation.run):
            self._pushed = data
            self._conversation.heard(now)

    def subscribe(self) -> None:
        """Receive every published snapshot from now on, unless compact snapshots are fetched. Idempotent."""
        key = keys.snapshots(self._conversation.run)
        if self._compact is None:
            if self._subscribed != key:
                self._unsubscribe()
            self._subscribed = key
            self._conversation.act(Subscribe(key))

    def use_compact_snapshots(self) -> None:
        """End the subscription; from now on compact snapshots are fetched, as often as a slow link allows."""
        self._unsubscribe()
        self._fetches_on_request = False
        self._fetcher = CompactSnapshotFetcher(self._conversation)

    def use_differences(self) -> None:
        """Fetch compact snapshots, as differences, in place of whole ones from now on. Idempotent.

        Only of a small network: the learner computes the differences, which for a large one takes longer than to send
        the whole.
        """
        if not self._fetches_on_request or self._compact is not None or self.newest is None:
            return
        if sum(array.nbytes for array in self.newest.weights.values()) <= _SMALL_BYTES:
            self._fetcher = CompactSnapshotFetcher(self._conversation, rests=False)

    def use_fetches(self) -> None:
        """End the subscription; from now on whole snapshots are fetched on request, unless compact ones are.

        Call this when there is a snapshot.
        """
        if self._compact is None:
            self._unsubscribe()
            assert self.newest is not None
            self._fetcher = SnapshotFetcher(self._conversation, self.newest.policy_version)
            self._fetches_on_request = True

    def _unsubscribe(self) -> None:
        if self._subscribed:
            self._conversation.act(Unsubscribe(self._subscribed))
            self._subscribed, self._pushed = "", None

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
        """The time of the last fetch on request; never too long ago if there are none."""
        return math.inf if self._scheduled is None else self._scheduled.requested_at

    def read(self) -> Steps[None]:
        """Decode what has come, and update `newest`.

        Raises RunOverError if the run finished, LearnerLostError if the message is from another learner epoch.
        """
        fetcher = self._fetcher
        message = None if fetcher is None else (yield from fetcher.take())
        if fetcher is not None and message is not None:
            self._apply(message, fetcher.answered_request_at)
        data, self._pushed = self._pushed, None
        message = None if data is None else (yield Work(partial(self._conversation.decode, data)))
        if message is not None:
            self._apply(message, self._conversation.now)

    @property
    def is_awaited(self) -> bool:
        """Whether a snapshot that was requested has not come yet."""
        return self._scheduled is not None and self._scheduled.in_progress

    def fetch(self) -> None:
        """Request the newest snapshot, if snapshots are fetched on request."""
        if self._scheduled is not None:
            self._scheduled.request_newest()

    def request_confirmation(self) -> None:
        """Ask whether `newest` is still the learner's newest, unless an answer is awaited."""
        if self._fetcher is None and self.newest is not None:
            self._fetcher = SnapshotFetcher(self._conversation, self.newest.policy_version)
        if self._fetcher is not None:
            self._fetcher.request_newest()

    def request_newest(self) -> Steps[None]:
        """Request the newest snapshot in case a push was lost. Raises as `read` does."""
        if self._compact is not None:
            self._compact.request_newest()
            return
        at = self._conversation.now
        for message in (yield from self._conversation.ask(keys.snapshots(self._conversation.run))):
            self._apply(message, at)

    def request_compact_if_behind(self, newest_version: int) -> None:
        """Request the snapshot of a version that acknowledgements mention, on a slow link."""
        is_behind = self.newest is None or newest_version > self.newest.policy_version
        if self._fetcher is not None and self.is_slow and is_behind:
            self._fetcher.request_newest()

    def _apply(self, message: Message, at: float) -> None:
        """Apply a message; `at` is the time of the request that it answers, or at which it was pushed."""
        if isinstance(message, RunEnded):
            self._conversation.run_ended(message)
            self._conversation.check_over()
        if isinstance(message, Refusal) and self._compact is None:  # the learner has none that is newer
            self.confirmed_at = at
        if not isinstance(message, Snapshot):
            return
        if message.learner_epoch != self._conversation.learner_epoch:
            raise LearnerLostError
        if self.newest is None or message.policy_version > self.newest.policy_version:
            self.newest = message
        if message.policy_version == self.newest.policy_version:
            self.confirmed_at = at


class FetchSchedule:
    """When an actor fetches a snapshot: so that it comes as the next rollout begins. All times are in seconds.

    An actor uses one snapshot for each rollout. If it fetched that snapshot when the rollout begins, it would wait for
    the answer; if it fetched the snapshot much earlier, the policy would be older than necessary.
    """

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
