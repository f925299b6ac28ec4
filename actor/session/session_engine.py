"""The actor's session with a learner: its waits, its choice of snapshots, its runtime."""

import logging
import threading
import time
from collections.abc import Callable

from daedalus.actor.errors import ActorError, ActorRefusedError, LearnerLostError
from daedalus.actor.session.actor_config import ActorConfig
from daedalus.actor.session.conversation import DRAINED, LearnerPresence, LearnerQueries, RunEndWatch, RunOverError
from daedalus.actor.session.session_thread import StateLock
from daedalus.actor.session.snapshots import FetchSchedule, SnapshotFeed
from daedalus.actor.session.uploading import UploadSession
from daedalus.policy.acting.runtime import OnnxRuntime, PolicyRuntime
from daedalus.protocol.messages import Join, Snapshot, Welcome
from daedalus.protocol.spaces import Spaces
from daedalus.protocol.spec import UnsupportedRunError

_POLL_SECONDS = 0.2  # how soon a wait notices `stop`
_SILENCE_SECONDS = 10.0  # without a message for so long, the actor asks whether the learner is there


class SessionMonitor:
    """The waits of one actor. Each is timed, sends the rollouts that fall due, and notices the session's end."""

    def __init__(
        self,
        uploads: UploadSession,
        presence: LearnerPresence,
        queries: LearnerQueries,
        join: Join,
        lock: StateLock,
        end: RunEndWatch,
        on_poll: Callable[[], None],
    ) -> None:
        """Construct the monitor.

        Args:
          uploads, presence, queries, lock, end: of the session.
          join: the request that asks whether the learner is there.
          on_poll: called in every wait, at least five times a second. It may raise as `check` does.
        """
        self._upload_session, self._presence, self._queries, self._join = uploads, presence, queries, join
        self._lock, self._end, self._on_poll = lock, end, on_poll

    def wait(self, ready: Callable[[], bool], timeout: float | None = None) -> bool:
        """Wait until `ready` returns True; return False if `timeout` seconds pass first. Raises as `check` does.

        `ready` is called after every announced change, without the lock: it may take its time, such as to decode a
        snapshot, while the transport's threads go on delivering.
        """
        deadline = None if timeout is None else time.monotonic() + timeout
        while True:
            self._upload_session.send_due()
            self._probe_if_silent()
            self._on_poll()
            changes = self._lock.changes
            self.check()
            if ready():
                self.check()  # a verdict that came while `ready` ran may be why it returned True
                return True
            now = time.monotonic()
            if deadline is not None and now >= deadline:
                return False
            with self._lock:
                due = self._upload_session.in_flight.next_due()
            until = min(moment for moment in (deadline, due, now + _POLL_SECONDS) if moment is not None)
            self._lock.wait_for_change(changes, max(until - now, 0.0))

    def wait_for_room(self) -> None:
        """Wait until one more rollout may be collected and sent. Raises as `check` does."""
        self.wait(lambda: self._upload_session.in_flight.has_room)

    def wait_for_message(self, timeout: float) -> None:
        """Wait for any message of the learner, at most `timeout` seconds. Raises as `check` does."""
        since = self._presence.heard_at
        self.wait(lambda: self._presence.heard_at > since, timeout)

    def check(self) -> None:
        """Raise if there is a reason to stop collecting.

        Raises as `check_over` does, and LearnerLostError if the learner left or does not accept rollouts of this
        learner epoch any more.
        """
        with self._lock:
            left = self._presence.left
        self.check_over()  # after the presence was read: a learner that finished says so before it leaves
        if self._end.learner_stopped:
            raise LearnerLostError("the learner was stopped; waiting for it to return")
        if left or self._upload_session.in_flight.ended_by == "fenced":
            raise LearnerLostError

    def check_over(self) -> None:
        """Raise if the session is over for good: its rollout need not be completed.

        Raises RunOverError if the run or the actor is over, ActorError in quarantine.
        """
        self._end.check()
        with self._lock:
            ended_by, reason = self._upload_session.in_flight.ended_by, self._upload_session.in_flight.reason
        if ended_by == "quarantined":
            raise ActorRefusedError(
                f"the learner quarantined this actor: {reason}; fix the cause and restart the actor"
            )
        if ended_by == "finished":
            raise RunOverError("the run is over", finished=True)
        if ended_by == "drained":
            raise RunOverError(DRAINED)

    def _probe_if_silent(self) -> None:
        """After a long silence ask whether the learner is there: a dead session can look alive.

        Raises LearnerLostError if nobody responds, and RunOverError as `check` does.
        """
        if time.monotonic() > self._presence.heard_at + _SILENCE_SECONDS:
            self._end.check()  # a request may take 5 s
            if not self._queries.learner_responds(self._upload_session.run, self._join):
                raise LearnerLostError
            self._presence.heard()


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


_logger = logging.getLogger(__name__)

_SLOW_LINK_SECONDS, _SLOW_LINK_RATE = 0.1, 1 << 20  # a link is slow beyond this latency and so many bytes a second


class RuntimeMaker:
    """Makes the runtime of an actor's policy in each session with a learner."""

    def __init__(
        self,
        config: ActorConfig,
        queries: LearnerQueries,
        feed: SnapshotFeed,
        monitor: SessionMonitor,
        end: RunEndWatch,
        stop: threading.Event,
    ) -> None:
        self._config, self._queries, self._feed = config, queries, feed
        self._monitor, self._end, self._stop = monitor, end, stop

    def make(self, welcome: Welcome, spaces: Spaces, environments: int) -> PolicyRuntime:
        """Return the runtime for a number of environments. Waits for the program of the learner, unless torch is used.

        If the program comes slowly, and the actor may choose, the feed uses compact snapshots from now on.
        """
        if self._config.runtime == "torch":
            from daedalus.policy.acting.torch_runtime import TorchRuntime  # the only part of an actor with torch

            try:
                learning = welcome.spec.learning_settings
            except UnsupportedRunError as error:
                raise ActorError(str(error)) from None
            return TorchRuntime(learning.policy, spaces, learning.training)
        rows = environments * welcome.spec.collection.rollout_length  # a rollout is played with one snapshot
        return OnnxRuntime(self._await_program(welcome), self._stop, rows)

    def _await_program(self, welcome: Welcome) -> bytes:
        """Return the program once the learner has it; measure the link by the time that it takes."""
        pause = FIRST_PUSH_SECONDS
        while True:
            began = time.monotonic()
            program = self._queries.program(welcome.run)
            if program is not None:
                break
            self._feed.subscribe()  # nothing is pushed yet: the first snapshot says that the program is there too
            self._monitor.wait_for_message(pause)
            self._feed.read()
            pause = min(2 * pause, MISSED_PUSH_SECONDS)
        if self._config.link == "auto" and not welcome.spec.algorithm.synchronous:
            self._measure_link(welcome, time.monotonic() - began, len(program[1]))
        return program[1]

    def _measure_link(self, welcome: Welcome, seconds: float, size: int) -> None:
        """Use compact snapshots if the program takes long again and again: once may be a busy machine."""
        allowed = _SLOW_LINK_SECONDS + size / _SLOW_LINK_RATE
        for _ in range(2):
            if seconds <= allowed:
                return
            self._end.check()  # a request may take 5 s
            began = time.monotonic()
            self._queries.program(welcome.run)
            seconds = time.monotonic() - began
        if seconds > allowed:
            _logger.info(
                "slow link: %s bytes took %.2f s; fetching compact snapshots as often as it allows",
                f"{size:,}",
                seconds,
            )
            self._feed.use_compact_snapshots()
