"""Follows a run on a thread of its own: finds its learner, loads its program and every newer snapshot."""

import logging
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

from daedalus.actor.errors import ActorError, LearnerLostError
from daedalus.actor.session.conversation import LearnerPresence, LearnerQueries, RunEndWatch, RunOverError
from daedalus.actor.session.session_thread import StateLock
from daedalus.actor.session.snapshots import SnapshotFeed
from daedalus.gateway.policy_versions import PolicyVersion
from daedalus.policy.acting.runtime import OnnxRuntime, PolicyError
from daedalus.protocol import keys
from daedalus.protocol.messages import Join, Snapshot, Welcome
from daedalus.transport.interface import Transport, TransportError
from daedalus.transport.retries import Retries

_logger = logging.getLogger(__name__)

_TICK_SECONDS = 0.02
_FIRST_PUSH_SECONDS, _MISSED_PUSH_SECONDS = 0.1, 1.0  # without the program or the first snapshot, ask again
_SILENCE_SECONDS = 10.0  # without a message for so long, ask whether the learner is there
_NEXT_RUN_SECONDS = 1.0  # after the end of a run, before the next is looked for
_FETCH_SHARE = 4.0  # a fetch begins this many times its own duration after the last


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class NewestPolicy:
    """The newest policy as messages, for another process."""

    session: Welcome
    program: bytes
    snapshot: Snapshot


class LinkEvents(Protocol):
    """What the gateway learns from the link. Called on the link's thread."""

    def on_learner(self, session: Welcome) -> None:
        """A learner was found; all actors must join it."""
        ...

    def on_policy(self, version: PolicyVersion) -> None:
        """A newer version is ready to act."""
        ...

    def on_run_over(self, reason: str) -> None:
        """The run has ended; another is looked for."""
        ...

    def on_failure(self, reason: str) -> None:
        """The gateway cannot take part in the run now; it tries again."""
        ...


class LearnerLink:
    """The gateway's view of one learner after the other."""

    def __init__(self, transport: Transport, join: Join, run: str, stop: threading.Event, events: LinkEvents) -> None:
        """Construct the link.

        Args:
          transport: the network; the caller closes it.
          join: the gateway's own request for a run's specification; it is no actor.
          run: the run to follow, or keys.ANY_RUN.
          stop: ends `run`.
          events: receives what happens.
        """
        self._transport, self._join, self._run_to_join, self._stop, self._events = transport, join, run, stop, events
        self.lock = StateLock()
        self.presence = LearnerPresence(self.lock)
        self.queries = LearnerQueries(transport)
        self.newest_version: Callable[[], int] = lambda: -1  # that an acknowledgement mentioned
        self._end = RunEndWatch(transport, stop)
        self._feed = SnapshotFeed(transport, self.queries, self._end, join.actor, self.presence.heard)
        self._watched: set[str] = set()
        self._failure: PolicyError | None = None  # of the policy, when it acted
        self._look_again = False  # an actor was fenced: another learner may have begun
        self._fetch_wanted = False
        self._follows = False  # whether `events` knows of the present learner
        self.newest_policy: NewestPolicy | None = None

    def look_again(self) -> None:
        """Look for the learner: an actor was fenced. From any thread."""
        self._look_again = True

    def fail(self, error: PolicyError) -> None:
        """Leave the learner: its policy does not run. From any thread."""
        self._failure = error

    def fetch(self) -> None:
        """Ask the learner for a newer snapshot, although no client has heard of one. From any thread."""
        self._fetch_wanted = True

    def run(self) -> None:
        """Follow learners until `stop` is set.

        Somebody else can remove what keeps the gateway from a run, such as a second run or a policy that does not run:
        the gateway reports it to the learner, if there is one, and tries again.
        """
        retries = Retries(self._stop)
        while not self._stop.is_set():
            try:
                session = self.queries.join_learner(self._run_to_join, self._join, None, self._end)
                self.presence.joined()
                self._follow(session)
            except LearnerLostError as error:
                _logger.info("%s", error)
            except RunOverError as error:
                if not error.finished:
                    return
                self._events.on_run_over(str(error))
                retries.succeeded()
                self._stop.wait(_NEXT_RUN_SECONDS)
            except (ActorError, PolicyError, TransportError) as error:
                self.queries.report_failure(self._end.run, self._join, error)
                if self._follows:
                    self._events.on_failure(str(error))
                retries.wait(str(error))
            finally:
                self._follows = False

    def _follow(self, session: Welcome) -> None:
        """Serve one session until something raises."""
        self._look_again, self._failure = False, None
        self._end.follow(session.run, session.learner_epoch)
        if session.run not in self._watched:
            self._watched.add(session.run)
            self._transport.watch_presence(keys.learner(session.run), self.presence.on_presence)
        _logger.info("follows run %r", session.run)
        self._feed.begin(session)
        self._feed.subscribe()
        self._events.on_learner(session)
        self._follows = True
        program = self._await_program(session.run)
        policy = OnnxRuntime(program, self._stop)
        self._await_snapshot()
        synchronous = session.spec.algorithm.synchronous
        if not synchronous:  # otherwise all actors wait for each version: it is pushed
            self._feed.use_fetches()
        loaded = -1
        while True:
            newest = self._feed.newest
            if newest is not None and newest.policy_version > loaded:
                runtime = policy.fork()
                runtime.load(newest.weights)
                loaded = newest.policy_version
                self.newest_policy = NewestPolicy(session=session, program=program, snapshot=newest)
                size = sum(array.nbytes for array in newest.weights.values())
                self._events.on_policy(
                    PolicyVersion(session=session, version=loaded, runtime=runtime, size=max(size, 1))
                )
            self._wait(_TICK_SECONDS)
            due = self._fetch_wanted or self.newest_version() > loaded
            if due and time.monotonic() > self._feed.fetched_at + self._pause():
                self._fetch_wanted = False
                self._feed.fetch()
            if synchronous and time.monotonic() > self._feed.confirmed_at + _MISSED_PUSH_SECONDS:
                self._feed.request_confirmation()
            self._feed.read()

    def _pause(self) -> float:
        """Return how long after a fetch the next may begin: large weights are not fetched without pause."""
        return _FETCH_SHARE * self._feed.fetch_seconds

    def _await_program(self, run: str) -> bytes:
        pause = _FIRST_PUSH_SECONDS
        while (program := self.queries.program(run)) is None:
            since = self.presence.heard_at  # nothing is pushed yet: the first snapshot says that there is a program
            deadline = time.monotonic() + pause
            while self.presence.heard_at == since and time.monotonic() < deadline:
                self._wait(_TICK_SECONDS)
            self._feed.read()
            pause = min(2 * pause, _MISSED_PUSH_SECONDS)
        return program[1]

    def _await_snapshot(self) -> None:
        while self._feed.newest is None:
            self._feed.request_newest()
            if self._feed.newest is None:
                self._wait(_FIRST_PUSH_SECONDS)
                self._feed.read()

    def _wait(self, seconds: float) -> None:
        """Wait; raise LearnerLostError or RunOverError if there is a reason."""
        self._stop.wait(seconds)
        left = self.presence.left  # read before the run's end: a learner that finished says so before it leaves
        self._end.check()
        if self._end.learner_stopped:
            raise LearnerLostError("the learner was stopped; waiting for it to return")
        if left or self._look_again:
            raise LearnerLostError
        if self._failure is not None:
            raise self._failure
        if time.monotonic() > self.presence.heard_at + _SILENCE_SECONDS:
            if not self.queries.learner_responds(self._end.run, self._join):
                raise LearnerLostError
            self.presence.heard()
