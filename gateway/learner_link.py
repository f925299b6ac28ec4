"""Follows a run on a thread of its own: finds its learner, loads its program and every newer snapshot."""

import logging
import threading
from dataclasses import dataclass
from typing import Protocol

from daedalus.actor.errors import ActorError, LearnerLostError
from daedalus.actor.session.actor_config import ActorConfig
from daedalus.actor.session.conversation import RunOverError, Steps, WatchPresence
from daedalus.actor.session.session_engine import PolicySession
from daedalus.actor.session.session_thread import SessionThread
from daedalus.gateway.policy_versions import PolicyVersion
from daedalus.policy.acting.runtime import OnnxRuntime, PolicyError
from daedalus.protocol import keys
from daedalus.protocol.messages import Origin, Snapshot, Welcome
from daedalus.transport.interface import Transport, TransportError
from daedalus.transport.retries import Retries

_logger = logging.getLogger(__name__)

_CONFIRM_SECONDS = 1.0  # where all actors wait for each version, the one that is held is confirmed so often
_NEXT_RUN_SECONDS = 1.0  # after the end of a run, before the next is looked for
_FETCH_SHARE, _LEAST_PAUSE_SECONDS = 4.0, 0.02  # a fetch begins so many times its own duration after the last


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


class LinkSession(PolicySession):
    """What the gateway itself says to learners: it follows their policies, and is no actor."""

    is_actor = False

    def __init__(self, config: ActorConfig, origin: Origin) -> None:
        super().__init__(config, origin)
        self._mentioned_version = -1  # of this learner epoch, by an acknowledgement
        self._fetch_wanted = False
        self._looks_again = False
        self._failure: PolicyError | None = None  # of the policy, when it acted

    # ------------------------------------------------------------------------------------------------ events

    def look_again(self) -> None:
        """Look for the learner: an actor was fenced."""
        self._looks_again = True

    def fail(self, error: PolicyError) -> None:
        """Leave the learner: its policy does not run."""
        self._failure = error

    def want_newest(self) -> None:
        """Fetch a newer snapshot, although no client has heard of one."""
        self._fetch_wanted = True

    def mention(self, epoch: int, version: int) -> None:
        """Note that a learner has a policy version."""
        if epoch == self.learner_epoch:
            self._mentioned_version = max(self._mentioned_version, version)

    # ------------------------------------------------------------------------------------------------- steps

    def check(self) -> None:
        """Raise if there is a reason to leave the learner: see Conversation."""
        super().check()
        if self._looks_again:
            raise LearnerLostError
        if self._failure is not None:
            raise self._failure

    def begin(self, session: Welcome) -> Steps[bytes]:
        """Follow the learner that was found; return its program."""
        self._looks_again, self._failure, self._mentioned_version = False, None, -1
        self.act(WatchPresence(keys.learner(session.run)))
        self.feed.begin()
        self.feed.subscribe()
        return (yield from self.await_program(session))

    def first_snapshot(self, session: Welcome) -> Steps[Snapshot]:
        """Return the first snapshot that comes."""
        yield from self.await_snapshot(lambda: self.feed.newest is not None)
        assert self.feed.newest is not None
        if not session.spec.algorithm.synchronous:  # otherwise all actors wait for each version: it is pushed
            self.feed.use_fetches()
        return self.feed.newest

    def next_snapshot(self, session: Welcome, held: int) -> Steps[Snapshot]:
        """Return a snapshot that is newer than the version that is held. It is fetched once a client has heard of it.

        Large weights are not fetched without pause.
        """
        while (newest := self.feed.newest) is None or newest.policy_version <= held:
            if self._next_fetch_at(held) <= self.now:
                self._fetch_wanted = False
                self.feed.fetch()
            if session.spec.algorithm.synchronous and self.now > self.feed.confirmed_at + _CONFIRM_SECONDS:
                self.feed.request_confirmation()
            pause = min(self._next_fetch_at(held) - self.now, _CONFIRM_SECONDS)
            yield from self.wait(lambda: self._has_newer(held), max(pause, _LEAST_PAUSE_SECONDS), reads=True)
        return newest

    def _has_newer(self, held: int) -> bool:
        newest = self.feed.newest
        return (newest is not None and newest.policy_version > held) or self._next_fetch_at(held) <= self.now

    def _next_fetch_at(self, held: int) -> float:
        """Return when to fetch; never if there is nothing to fetch, or a fetch is in progress."""
        if self.feed.is_awaited or not (self._fetch_wanted or self._mentioned_version > held):
            return float("inf")
        return self.feed.fetched_at + max(_FETCH_SHARE * self.feed.fetch_seconds, _LEAST_PAUSE_SECONDS)


class LearnerLink:
    """The gateway's view of one learner after the other."""

    def __init__(self, session: LinkSession, transport: Transport, stop: threading.Event, events: LinkEvents) -> None:
        """Construct the link.

        Args:
          session: what it says to learners.
          transport: the network; the caller closes it.
          stop: ends `run`.
          events: receives what happens.
        """
        self._session, self._stop, self._events = session, stop, events
        self._thread = SessionThread(session, transport, stop)
        self._follows = False  # whether `events` knows of the present learner
        self.newest_policy: NewestPolicy | None = None

    def look_again(self) -> None:
        """See LinkSession. From any thread, as the next three."""
        self._thread.notify(self._session.look_again)

    def fail(self, error: PolicyError) -> None:
        """See LinkSession."""
        self._thread.notify(self._session.fail, error)

    def fetch(self) -> None:
        """See LinkSession.want_newest."""
        self._thread.notify(self._session.want_newest)

    def mention(self, epoch: int, version: int) -> None:
        """See LinkSession."""
        self._thread.notify(self._session.mention, epoch, version)

    def run(self) -> None:
        """Follow learners until `stop` is set.

        Somebody else can remove what keeps the gateway from a run, such as a second run or a policy that does not run:
        the gateway reports it to the learner, if there is one, and tries again.
        """
        retries = Retries(self._stop)
        while not self._stop.is_set():
            try:
                self._follow(self._thread.run(self._session.find_learner()))
            except LearnerLostError as error:
                _logger.info("%s", error)
            except RunOverError as error:
                if not error.finished:
                    return
                self._events.on_run_over(str(error))
                retries.succeeded()
                self._stop.wait(_NEXT_RUN_SECONDS)
            except (ActorError, PolicyError, TransportError) as error:
                self._thread.run(self._session.report_failure(error), to_the_end=True)
                if self._follows:
                    self._events.on_failure(str(error))
                retries.wait(str(error))
            finally:
                self._follows = False

    def _follow(self, session: Welcome) -> None:
        """Serve one session until something raises."""
        _logger.info("follows run %r", session.run)
        self._events.on_learner(session)
        self._follows = True
        program = self._thread.run(self._session.begin(session))
        policy = OnnxRuntime(program, self._stop)
        snapshot = self._thread.run(self._session.first_snapshot(session))
        while True:
            runtime = policy.fork()
            runtime.load(snapshot.weights)
            self.newest_policy = NewestPolicy(session=session, program=program, snapshot=snapshot)
            size = max(sum(array.nbytes for array in snapshot.weights.values()), 1)
            version, lessons = snapshot.policy_version, snapshot.lessons
            self._events.on_policy(
                PolicyVersion(session=session, version=version, runtime=runtime, size=size, lessons=lessons)
            )
            snapshot = self._thread.run(self._session.next_snapshot(session, version))
