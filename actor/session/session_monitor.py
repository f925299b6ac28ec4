"""The waits of an actor's thread: for room to send, for snapshots, or for a reason to stop collecting."""

import time
from collections.abc import Callable

from daedalus.actor.errors import ActorRefusedError, LearnerLostError
from daedalus.actor.session.learner_presence import LearnerPresence
from daedalus.actor.session.learner_queries import LearnerQueries
from daedalus.actor.session.run_end import DRAINED, RunEndWatch, RunOverError
from daedalus.actor.session.state_lock import StateLock
from daedalus.actor.session.upload_session import UploadSession
from daedalus.protocol.messages import Join

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
