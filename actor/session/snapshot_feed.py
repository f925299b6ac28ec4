"""The newest snapshot of a learner, however it comes: pushed to all, or fetched where the link is slow. No threads."""

import time
from collections.abc import Callable

from daedalus.actor.session.compact_snapshot_fetcher import CompactSnapshotFetcher
from daedalus.actor.session.learner_queries import LearnerLostError, LearnerQueries, RunOverError
from daedalus.protocol import keys
from daedalus.protocol.messages import Message, RunEnded, Snapshot, Welcome
from daedalus.transport.interface import Inbox, Transport

_DOUBT_SECONDS = 1.0  # this long without a snapshot that answers told of, it is asked for


class SnapshotFeed:
    """What comes from one learner after the other. Its methods but `on_news` are for one thread."""

    def __init__(self, transport: Transport, link: LearnerQueries, actor: str, on_news: Callable[[], None]) -> None:
        self._transport, self._link, self._actor, self._on_news = transport, link, actor, on_news
        self._inboxes: dict[str, Inbox] = {}  # by run
        self._slow: CompactSnapshotFetcher | None = None
        self._run, self._learner_epoch = "", -1
        self._came_at = 0.0
        self.newest: Snapshot | None = None  # of this learner epoch

    def attend(self, welcome: Welcome) -> None:
        """Begins anew with a learner."""
        self._run, self._learner_epoch, self.newest = welcome.run, welcome.learner_epoch, None
        self._slow = None

    def follow(self) -> None:
        """Has every snapshot pushed from now on, unless the link is spared."""
        if self._slow is None and self._run not in self._inboxes:
            self._inboxes[self._run] = self._transport.subscribe(keys.snapshots(self._run), self._on_news)

    def use_compact_snapshots(self) -> None:
        """From now on nothing is pushed: compact snapshots are fetched."""
        for inbox in self._inboxes.values():
            inbox.close()
        self._inboxes.clear()
        self._slow = CompactSnapshotFetcher(self._transport, self._run, self._actor, self._on_news)

    @property
    def uses_compact_snapshots(self) -> bool:
        """Whether snapshots are fetched."""
        return self._slow is not None

    def read(self) -> None:
        """Takes in what has come. Raises RunOverError after a run_ended, LearnerLostError if another learner speaks."""
        if self._slow is not None:
            news = self._slow.take()
        else:
            inbox = self._inboxes.get(self._run)
            data = None if inbox is None else inbox.take()
            news = None if data is None else self._link.decode(data)
        if news is not None:
            self._take(news)

    def ask(self) -> None:
        """Has the newest snapshot come, in doubt whether it was pushed. Raises as `read` does."""
        if self._slow is not None:
            self._slow.want()
            return
        for message in self._link.newest(self._run):
            self._take(message)

    def keep_up(self, newest_version: int) -> None:
        """Asks for a version that the learner's answers tell of, if it does not come by itself. Raises as `read`."""
        missed = self.newest is None or newest_version > self.newest.policy_version
        if missed and (self._slow is not None or time.monotonic() > self._came_at + _DOUBT_SECONDS):
            self._came_at = time.monotonic()
            self.ask()

    def _take(self, news: Message) -> None:
        if isinstance(news, RunEnded) and news.learner_epoch == self._learner_epoch:
            raise RunOverError(f"the run is over: {news.reason}")
        if not isinstance(news, Snapshot):
            return
        if news.learner_epoch != self._learner_epoch:
            raise LearnerLostError
        if self.newest is None or news.policy_version > self.newest.policy_version:
            self.newest, self._came_at = news, time.monotonic()
