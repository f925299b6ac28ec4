"""The newest snapshot of a learner: pushed to synchronous actors, fetched by all others. No threads."""

import math
from collections.abc import Callable

from daedalus.actor.session.compact_snapshot_fetcher import CompactSnapshotFetcher
from daedalus.actor.session.learner_queries import LearnerLostError, LearnerQueries
from daedalus.actor.session.run_end import RunEndWatch
from daedalus.actor.session.snapshot_fetcher import SnapshotFetcher
from daedalus.protocol import keys
from daedalus.protocol.messages import Message, RunEnded, Snapshot, Welcome
from daedalus.transport.interface import Inbox, Transport


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
        self._whole: SnapshotFetcher | None = None  # at most one of these two is set
        self._compact: CompactSnapshotFetcher | None = None
        self._run, self._learner_epoch = "", -1
        self.newest: Snapshot | None = None  # of this learner epoch

    def begin(self, welcome: Welcome) -> None:
        """Begin with a learner: no snapshot of it is known, and nothing about its link."""
        self._run, self._learner_epoch, self.newest = welcome.run, welcome.learner_epoch, None
        self._whole = self._compact = None

    def subscribe(self) -> None:
        """Receive every published snapshot from now on, unless compact snapshots are fetched. Idempotent."""
        if self._compact is None and self._run not in self._inboxes:
            self._inboxes[self._run] = self._transport.subscribe(keys.snapshots(self._run), self._on_news)

    def use_compact_snapshots(self) -> None:
        """End the subscription; from now on compact snapshots are fetched on request."""
        self._unsubscribe()
        self._compact = CompactSnapshotFetcher(self._transport, self._run, self._actor, self._on_news)

    def use_fetches(self) -> None:
        """End the subscription; from now on whole snapshots are fetched on request, unless compact ones are.

        Call this when there is a snapshot.
        """
        if self._compact is None:
            self._unsubscribe()
            assert self.newest is not None
            self._whole = SnapshotFetcher(
                self._transport, self._queries, self._run, self._actor, self.newest.policy_version, self._on_news
            )

    def _unsubscribe(self) -> None:
        for inbox in self._inboxes.values():
            inbox.close()
        self._inboxes.clear()

    @property
    def uses_compact_snapshots(self) -> bool:
        """Whether compact snapshots are fetched."""
        return self._compact is not None

    @property
    def fetch_seconds(self) -> float:
        """How long the last fetch of a whole snapshot took."""
        return 0.0 if self._whole is None else self._whole.seconds

    @property
    def fetched_at(self) -> float:
        """The monotonic time of the last request for a whole snapshot; never too long ago if none are fetched."""
        return math.inf if self._whole is None else self._whole.requested_at

    def read(self) -> None:
        """Decode what has come, and update `newest`. May take long: hold no lock meanwhile.

        Raises RunOverError if the run finished, LearnerLostError if the message is from another learner epoch.
        """
        if self._compact is not None:
            message = self._compact.take()
        elif self._whole is not None:
            message = self._whole.take()
        else:
            inbox = self._inboxes.get(self._run)
            data = None if inbox is None else inbox.take()
            message = None if data is None else self._queries.decode(data)
        if message is not None:
            self._apply(message)

    def is_current(self) -> bool:
        """Read what has come, and return whether no whole snapshot is awaited. Raises as `read` does."""
        awaited = self._whole is not None and self._whole.in_progress
        self.read()
        return not awaited

    def fetch(self) -> None:
        """Request the newest whole snapshot, if whole snapshots are fetched. Does not wait."""
        if self._whole is not None:
            self._whole.request_newest()

    def request_newest(self) -> None:
        """Request the newest snapshot in case a push was lost. Raises as `read` does."""
        if self._compact is not None:
            self._compact.request_newest()
            return
        for message in self._queries.newest_snapshot(self._run):
            self._apply(message)

    def request_compact_if_behind(self, newest_version: int) -> None:
        """Request the compact snapshot of a version that acknowledgements mention, if compact snapshots are fetched."""
        if self._compact is not None and (self.newest is None or newest_version > self.newest.policy_version):
            self._compact.request_newest()

    def _apply(self, message: Message) -> None:
        if isinstance(message, RunEnded):
            self._end.apply(message)
        if not isinstance(message, Snapshot):
            return
        if message.learner_epoch != self._learner_epoch:
            raise LearnerLostError
        if self.newest is None or message.policy_version > self.newest.policy_version:
            self.newest = message
