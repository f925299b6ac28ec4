"""The newest snapshot of a learner: pushed to synchronous actors, fetched by all others. No threads."""

import math
import time
from collections.abc import Callable, Iterator

from daedalus.actor.errors import LearnerLostError
from daedalus.actor.session.compact_snapshot_fetcher import CompactSnapshotFetcher
from daedalus.actor.session.learner_queries import LearnerQueries
from daedalus.actor.session.run_end import RunEndWatch
from daedalus.actor.session.snapshot_fetcher import SnapshotFetcher
from daedalus.protocol import keys
from daedalus.protocol.messages import Message, Refusal, RunEnded, Snapshot, Welcome
from daedalus.transport.interface import Inbox, Transport

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
