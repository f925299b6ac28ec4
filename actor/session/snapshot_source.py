"""The snapshot that the next rollout is collected with. Waits through the session's monitor; no threads of its own."""

import time

from daedalus.actor.session.fetch_schedule import FetchSchedule
from daedalus.actor.session.session_monitor import SessionMonitor
from daedalus.actor.session.snapshot_feed import SnapshotFeed
from daedalus.actor.session.upload_session import UploadSession
from daedalus.protocol.messages import Snapshot

FIRST_PUSH_SECONDS = 0.02  # before the first snapshot: the learner may be about to have one; doubles
_SLOW_SECONDS, _SLOW_ROLLOUTS = 0.25, 3  # the first rollout of an environment may be slow
MISSED_PUSH_SECONDS = 1.0  # without the awaited snapshot for so long, request it


class SnapshotSource:
    """The choice of snapshots in one session with a learner."""

    def __init__(self, feed: SnapshotFeed, monitor: SessionMonitor, uploads: UploadSession) -> None:
        self._feed, self._monitor, self._upload_session = feed, monitor, uploads
        self._schedule = FetchSchedule()
        self._slow_rollouts = 0  # in a row

    def begin_rollout(self) -> None:
        """Note that a rollout begins."""
        self._schedule.begin_rollout(time.monotonic(), self._feed.fetch_seconds)

    def end_rollout(self) -> None:
        """Note that the rollout is complete."""
        self._schedule.end_rollout(time.monotonic())
        self._slow_rollouts = self._slow_rollouts + 1 if self._schedule.rollout_seconds > _SLOW_SECONDS else 0

    @property
    def rollouts_are_slow(self) -> bool:
        """Whether the last rollouts each took so long that to fetch differences costs the learner little."""
        return self._slow_rollouts >= _SLOW_ROLLOUTS

    def fetch_if_due(self) -> None:
        """Request the snapshot of the next rollout, if this one is about to end and the next can begin at once."""
        if self._schedule.is_due(time.monotonic()) and self._upload_session.in_flight.has_room_for(2):
            self._feed.fetch()

    def await_newer(self, version: int) -> Snapshot:
        """Wait for a snapshot newer than a version; request it in case a push was lost.

        Return early if the rollout that the version depends on was rejected: the actor must replace it. Not if a newer
        version is out, whose push was late or lost: a rollout of this version would be rejected again.
        """
        first = version < 0

        def ready() -> bool:
            self._feed.read()
            newest, in_flight = self._feed.newest, self._upload_session.in_flight
            if newest is not None and newest.policy_version > version:
                return True
            return in_flight.last_was_rejected and not first and in_flight.newest_version <= version

        pause = FIRST_PUSH_SECONDS if first else MISSED_PUSH_SECONDS
        while not self._monitor.wait(ready, pause):
            pause = min(2 * pause, MISSED_PUSH_SECONDS)
            self._feed.request_newest()
        self._upload_session.clear_rejection()
        return self._newest()

    def newest(self, waited: float) -> Snapshot:
        """Return the snapshot for a rollout that begins now, after it has `waited` seconds for room.

        A snapshot that is on its way is awaited for as long as that, or for a small part of the rollout's duration.
        """
        now = time.monotonic()
        if self._schedule.is_stale(now, self._feed.fetched_at):
            self._feed.fetch()
        self._monitor.wait(self._feed.is_current, max(waited, self._schedule.patience))
        return self._read()

    def newest_that_came(self) -> Snapshot:
        """Return the newest snapshot that has come."""
        self._monitor.check()
        return self._read()

    def _read(self) -> Snapshot:
        self._feed.read()
        self._feed.request_compact_if_behind(self._upload_session.in_flight.newest_version)
        return self._newest()

    def _newest(self) -> Snapshot:
        assert self._feed.newest is not None
        return self._feed.newest
