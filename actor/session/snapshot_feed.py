"""The newest snapshot of a learner: pushed to all actors, or fetched in compact form over a slow link. No threads."""

import time
from collections.abc import Callable

from daedalus.actor.session.compact_snapshot_fetcher import CompactSnapshotFetcher
from daedalus.actor.session.learner_queries import LearnerLostError, LearnerQueries
from daedalus.actor.session.run_end import RunEndWatch
from daedalus.protocol import keys
from daedalus.protocol.messages import Message, RunEnded, Snapshot, Welcome
from daedalus.transport.interface import Inbox, Transport

_MISSED_PUSH_SECONDS = 1.0  # so long after the last snapshot, one that acknowledgements mention is requested


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
        self._fetcher: CompactSnapshotFetcher | None = None  # set on a slow link
        self._run, self._learner_epoch = "", -1
        self._updated_at = 0.0  # when the newest snapshot came or was requested
        self.newest: Snapshot | None = None  # of this learner epoch

    def begin(self, welcome: Welcome) -> None:
        """Begin with a learner: no snapshot of it is known, and nothing about its link."""
        self._run, self._learner_epoch, self.newest = welcome.run, welcome.learner_epoch, None
        self._fetcher = None

    def subscribe(self) -> None:
        """Receive every published snapshot from now on, unless compact snapshots are fetched. Idempotent."""
        if self._fetcher is None and self._run not in self._inboxes:
            self._inboxes[self._run] = self._transport.subscribe(keys.snapshots(self._run), self._on_news)

    def use_compact_snapshots(self) -> None:
        """End the subscription; from now on compact snapshots are fetched on request."""
        for inbox in self._inboxes.values():
            inbox.close()
        self._inboxes.clear()
        self._fetcher = CompactSnapshotFetcher(self._transport, self._run, self._actor, self._on_news)

    @property
    def uses_compact_snapshots(self) -> bool:
        """Whether compact snapshots are fetched."""
        return self._fetcher is not None

    def read(self) -> None:
        """Decode what has come, and update `newest`. May take long: hold no lock meanwhile.

        Raises RunOverError if the run finished, LearnerLostError if the message is from another learner epoch.
        """
        if self._fetcher is not None:
            message = self._fetcher.take()
        else:
            inbox = self._inboxes.get(self._run)
            data = None if inbox is None else inbox.take()
            message = None if data is None else self._queries.decode(data)
        if message is not None:
            self._apply(message)

    def request_newest(self) -> None:
        """Request the newest snapshot in case a push was lost. Raises as `read` does."""
        if self._fetcher is not None:
            self._fetcher.request_newest()
            return
        for message in self._queries.newest_snapshot(self._run):
            self._apply(message)

    def request_if_behind(self, newest_version: int) -> None:
        """Request the snapshot of a version that acknowledgements mention, if its push is late. Raises as `read`."""
        behind = self.newest is None or newest_version > self.newest.policy_version
        if behind and (self._fetcher is not None or time.monotonic() > self._updated_at + _MISSED_PUSH_SECONDS):
            self._updated_at = time.monotonic()
            self.request_newest()

    def _apply(self, message: Message) -> None:
        if isinstance(message, RunEnded):
            self._end.apply(message)
        if not isinstance(message, Snapshot):
            return
        if message.learner_epoch != self._learner_epoch:
            raise LearnerLostError
        if self.newest is None or message.policy_version > self.newest.policy_version:
            self.newest, self._updated_at = message, time.monotonic()
