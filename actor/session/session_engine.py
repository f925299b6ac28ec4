"""The actor's session with one learner after the other: which snapshots it plays, what it uploads, and when.

Parts of the conversation (conversation.py), so without I/O, threads or clock. Besides the actions there, an actor's
session yields `Prepare`, `Begin`, `Load`, `Collect` and `Encode`.
"""

import logging
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Never

from daedalus.actor.errors import ActorError, LearnerLostError
from daedalus.actor.session.actor_config import ActorConfig
from daedalus.actor.session.conversation import LEAVES, Conversation, RunOverError, Steps, Wait, WatchPresence
from daedalus.actor.session.league_feed import LeagueFeed
from daedalus.actor.session.snapshots import FetchSchedule, SnapshotFeed
from daedalus.actor.session.uploading import ACTOR_PAUSE_SECONDS, CLIENT_PAUSE_SECONDS, Pace, Reports, Uploads
from daedalus.protocol import keys
from daedalus.protocol.messages import UNKNOWN, ClientReport, Origin, Snapshot, Welcome
from daedalus.protocol.spaces import Spaces
from daedalus.protocol.spec import ActorSpec
from daedalus.protocol.texts import mebibytes
from daedalus.protocol.uploads import Rollout, RolloutIdentity

_logger = logging.getLogger(__name__)

_FIRST_PUSH_SECONDS = 0.02  # before the first program and snapshot: the learner may be about to have one; doubles
_MISSED_PUSH_SECONDS = 1.0  # without the awaited program or snapshot for so long, request it
_SLOW_LINK_SECONDS, _SLOW_LINK_RATE = 0.1, 1 << 20  # a link is slow beyond this latency and so many bytes a second
_SLOW_SECONDS, _SLOW_ROLLOUTS = 0.25, 3  # the first rollout of an environment may be slow
_SLOW_LINK_WINDOW = 4  # most rollouts in flight on a slow link, unless the run asks for more
_CONFIRMATIONS = 4  # requests for a newer snapshot within the largest age of the policy
_REFRESH_SECONDS = 0.2  # while a client fills a rollout, and between requests for a confirmation
_UPLOAD_SECONDS = 5.0  # of the time to leave, for the last rollout to reach the learner
_MANY_REJECTIONS = 20  # warn after this many consecutive rejections


@dataclass(frozen=True, slots=True)
class Prepare:
    """Prepare for a learner's run; send back the spaces and E, the number of environments."""

    welcome: Welcome


@dataclass(frozen=True, slots=True)
class Begin:
    """Make the runtime of the policy, and begin to collect with it."""

    welcome: Welcome
    spaces: Spaces
    environments: int
    program: bytes | None  # None: the actor's own network, in torch


@dataclass(frozen=True, slots=True)
class Load:
    """Use a snapshot, which was the learner's newest at a time, from the next rollout on."""

    snapshot: Snapshot | None  # None: the one that is loaded already
    confirmed_at: float


@dataclass(frozen=True, slots=True)
class Collect:
    """Send back the next rollout, or None if a client has not filled it.

    Before each row, call `ActorSession.begin_row`, and then `act_in_rollout` if it returns True, else `check_over`.
    """

    identity: RolloutIdentity


@dataclass(frozen=True, slots=True)
class Encode:
    """Send back the bytes to upload of a rollout."""

    rollout: Rollout


class PolicySession(Conversation):
    """A conversation that follows a learner's policy."""

    def __init__(self, config: ActorConfig, origin: Origin = UNKNOWN) -> None:
        super().__init__(config, origin)
        self.feed = SnapshotFeed(self)

    def received(self, key: str, data: bytes) -> None:
        """See Conversation."""
        super().received(key, data)
        self.feed.received(key, data, self.now)

    def wait(self, ready: Callable[[], bool], timeout: float | None = None, *, reads: bool = False) -> Steps[bool]:
        """Wait until `ready` returns True; return False if `timeout` seconds pass first. Raises as `check` does.

        `ready` is called after every event; `reads`: once the snapshot that may have come is read.
        """
        deadline = None if timeout is None else self.now + timeout
        while True:
            yield from self.between()
            self.check()
            if reads:
                yield from self.feed.read()
            if ready():
                self.check()  # a verdict that came while `ready` ran may be why it returned True
                return True
            if deadline is not None and self.now >= deadline:
                return False
            yield Wait(min(moment for moment in (deadline, *self.due_times()) if moment is not None))

    def between(self) -> Steps[None]:
        """Do what falls due in a wait. Raises as `check` does."""
        yield from self.probe_if_silent()

    def due_times(self) -> list[float | None]:
        """Return when `between` has something to do."""
        return [self.silent_at]

    def await_program(self, welcome: Welcome) -> Steps[bytes]:
        """Return the program once the learner has it; measure the link by the time that it takes.

        If it comes slowly, and the actor may choose, compact snapshots are fetched from now on.
        """
        pause = _FIRST_PUSH_SECONDS
        while True:
            began = self.now
            program = yield from self.program()
            if program is not None:
                break
            self.feed.subscribe()  # nothing is pushed yet: the first snapshot says that the program is there too
            since = self.heard_at
            yield from self.wait(lambda since=since: self.heard_at > since, pause)
            yield from self.feed.read()
            pause = min(2 * pause, _MISSED_PUSH_SECONDS)
        if self.config.link == "auto" and not welcome.spec.algorithm.synchronous:
            yield from self._measure_link(self.now - began, len(program))
        return program

    def _measure_link(self, seconds: float, size: int) -> Steps[None]:
        """Use compact snapshots if the program takes long again and again: once may be a busy machine."""
        allowed = _SLOW_LINK_SECONDS + size / _SLOW_LINK_RATE
        for _ in range(2):
            if seconds <= allowed:
                return
            self.check_over()  # a request may take 5 s
            began = self.now
            yield from self.program()
            seconds = self.now - began
        if seconds > allowed:
            _logger.info(
                "slow link: %s bytes took %.2f s; fetching compact snapshots as often as it allows",
                f"{size:,}",
                seconds,
            )
            self.feed.use_compact_snapshots()

    def await_snapshot(self, is_enough: Callable[[], bool], pause: float = _FIRST_PUSH_SECONDS) -> Steps[None]:
        """Wait until what has come is enough; after a growing pause request the newest snapshot: a push may be lost."""
        while not (yield from self.wait(is_enough, pause, reads=True)):
            pause = min(2 * pause, _MISSED_PUSH_SECONDS)
            yield from self.feed.request_newest()


class ActorSession(PolicySession):
    """All that one actor says to learners, and does between it.

    Attributes:
      rollout_ready: set this when a client has filled a rollout.
      sequence: number of the next rollout in this learner epoch.
      has_opponents: whether opponents may play in its games. Whoever performs `Prepare` sets it.
    """

    def __init__(
        self, config: ActorConfig, origin: Origin = UNKNOWN, report: Callable[[], ClientReport] | None = None
    ) -> None:
        """`report` returns what a client counts about itself; None: this actor is no client."""
        super().__init__(config, origin)
        nothing = ClientReport(actor=config.name, incarnation=config.incarnation)
        self._counts = report or (lambda: nothing)
        self.uploads = Uploads(config.name, self.heard)
        self.rollout_ready = False
        self.sequence = 0
        self._plays = self._is_collecting = False
        self._schedule = FetchSchedule()
        self._pace, self._is_filling = Pace(), False  # whether a client fills a rollout
        pause = ACTOR_PAUSE_SECONDS if report is None else CLIENT_PAUSE_SECONDS
        self.reports = Reports(lambda: self._pace.added_to(self._counts(), self.now), pause)
        self._is_fetch_due = False  # in the rollout that is being played
        self._played_epoch = -1  # of the learner that has the rollouts in flight
        self._loaded_version = -1  # the policy version that the actor plays
        self._confirm_at = 0.0  # not before this time, a confirmation of the policy is requested
        self._slow_rollouts = 0  # in a row
        self.has_opponents, self._league = False, LeagueFeed(self)
        self._warned_of_rejections = False

    def play(self) -> Steps[Never]:
        """Take part in runs until something raises.

        Raises RunOverError if the run is over, ActorError if the actor is refused or quarantined, or finds no learner
        within its timeout.
        """
        while True:
            try:
                welcome = yield from self.find_learner()
                yield from self._play_with(welcome)
            except LearnerLostError as error:
                _logger.info("run %r: %s", self.run, error)
                self._plays = self._is_collecting = False

    # ------------------------------------------------------------------------------- what ends a session, and waits

    def check_over(self) -> None:
        """Raise if the session is over for good: its rollout need not be completed.

        Raises RunOverError if the run or the actor is over, ActorError in quarantine.
        """
        super().check_over()
        self.uploads.check_over()

    def check_leave(self, by: float) -> None:
        """See Conversation. The present rollout is finished and its verdict awaited, if there is time for both."""
        unjudged, lost = len(self.uploads.in_flight.rollouts), list[str]()
        if self._is_collecting:
            if self.now < by - _UPLOAD_SECONDS:
                return
            lost.append(f"the rollout under way is lost ({self._pace.rows_played:,} rows in each environment)")
        elif self._plays and unjudged and self.now < by:
            return
        if unjudged:
            lost.append(f"{unjudged:,} uploaded rollouts had no verdict yet, and may be lost")
        raise RunOverError(f"{LEAVES}: {'; '.join(lost) or 'no rollout is lost'}")

    def check(self) -> None:
        """Raise if there is a reason to stop collecting: see Conversation, and Uploads."""
        super().check()
        self.uploads.check()

    def between(self) -> Steps[None]:
        """Send what is due, and keep the policy from growing too old: its learner may be busy for long."""
        self.act(*self.uploads.take_due(self.now))
        yield from super().between()
        # An actor that waits for the learner is well. A client is if its loop makes rows.
        self.act(*self.reports.take_due(self.run, self.now, repeats=not self._is_filling))
        confirm_at = self._confirmation_due()
        if confirm_at is None:
            return
        yield from self.feed.read()
        yield self._load()
        if self.now >= confirm_at:
            self._confirm_at = self.now + _REFRESH_SECONDS
            self.feed.request_confirmation()

    def due_times(self) -> list[float | None]:
        """See PolicySession."""
        in_flight_at = self.uploads.in_flight.next_due()
        return [*super().due_times(), self.leave_by, in_flight_at, self.reports.next_at, self._confirmation_due()]

    def _confirmation_due(self) -> float | None:
        """Return when to ask whether the policy is the newest; None if its age does not matter."""
        if self.config.max_policy_age is None or self._loaded_version < 0 or self.feed.newest is None:
            return None
        return max(self._confirm_at, self.feed.confirmed_at + self.config.max_policy_age / _CONFIRMATIONS)

    # ---------------------------------------------------------------------------------------------- joining

    def _play_with(self, welcome: Welcome) -> Steps[None]:
        """Prepare the environments, join with their spaces, then collect until the learner or the run ends."""
        self._loaded_version = -1
        spaces, count = yield Prepare(welcome)
        self.feed.begin()
        self._league.begin()
        self.act(WatchPresence(keys.learner(welcome.run)))
        self.reports.begin()
        welcome = yield from self.confirm(welcome, replace(self.join, spaces=spaces, environments=count))
        spec = welcome.spec
        self._pace.join(spec.collection.rollout_length)
        self._is_filling = False
        if welcome.learner_epoch == self._played_epoch:  # the network failed, not the learner
            self.uploads.resume()
        else:
            self.uploads.begin(welcome.run, spec.collection.window)
            self._played_epoch, self.sequence = welcome.learner_epoch, 0
        if self.config.link == "wan" and not spec.algorithm.synchronous:
            self.feed.use_compact_snapshots()
        _logger.info("joined run %r as %r: %d x %s", welcome.run, self.config.name, count, spec.environment.id)
        program = None if self.config.runtime == "torch" else (yield from self.await_program(welcome))
        yield Begin(welcome, _as_the_learner(spaces, welcome), count, program)
        if spec.algorithm.synchronous:
            self.feed.subscribe()
        yield from self._collect_and_upload(spec)

    # ------------------------------------------------------------------------------------------- collecting

    def _collect_and_upload(self, spec: ActorSpec) -> Steps[None]:
        """Collect and upload until something raises: the session's end, or an error."""
        synchronous, window = spec.algorithm.synchronous, spec.collection.window
        yield from self._await_newer(-1)
        self._plays = True
        if not synchronous:
            self.feed.use_fetches()
        while True:
            began_waiting = self.now
            # Before collecting, so that the rollout is of the newest policy.
            yield from self.wait(lambda: self.uploads.in_flight.has_room)
            self._warn_of_rejections()
            if not synchronous:
                yield from self._await_fetch(self.now - began_waiting)
            yield self._load()
            if self.has_opponents:
                assert self.feed.newest is not None
                yield from self._league.follow(self.feed.newest.program)
            began = self.now
            if self.leave_by is not None:
                yield from self.wait(lambda: False)  # until `check_leave` raises
            self._pace.begin_rollout(self.now)
            self._is_collecting = True
            rollout = yield from self._collect()
            self._is_collecting = False
            payload = yield Encode(rollout)
            self._pace.end_rollout(self.now)
            if self.config.link == "auto" and self._slow_rollouts >= _SLOW_ROLLOUTS:
                self.feed.use_differences()  # they cost the learner little
            if self.feed.is_slow:
                self.uploads.in_flight.size_window(self.now - began, window, max(window, _SLOW_LINK_WINDOW))
            _check_size(payload, spec)
            self.uploads.in_flight.add(self.sequence, payload)
            self.act(*self.uploads.take_due(self.now))
            self.sequence += 1
            if synchronous:
                yield from self._await_newer(self._loaded_version)

    def _await_newer(self, version: int) -> Steps[None]:
        """Wait for a snapshot newer than a version; request it in case a push was lost.

        Return early if the rollout that the version depends on was rejected: the actor must replace it. Not if a newer
        version is out, whose push was late or lost: a rollout of this version would be rejected again.
        """
        first = version < 0

        def is_enough() -> bool:
            newest, in_flight = self.feed.newest, self.uploads.in_flight
            if newest is not None and newest.policy_version > version:
                return True
            return in_flight.last_was_rejected and not first and in_flight.newest_version <= version

        yield from self.await_snapshot(is_enough, _FIRST_PUSH_SECONDS if first else _MISSED_PUSH_SECONDS)
        self.uploads.in_flight.last_was_rejected = False

    def _await_fetch(self, waited: float) -> Steps[None]:
        """Read the snapshot for a rollout that begins now, after it has `waited` seconds for room.

        A snapshot that is on its way is awaited for as long as that, or for a small part of the rollout's duration.
        """
        if self._schedule.is_stale(self.now, self.feed.fetched_at):
            self.feed.fetch()
        yield from self.wait(lambda: not self.feed.is_awaited, max(waited, self._schedule.patience))
        yield from self._read()

    def _read(self) -> Steps[None]:
        yield from self.feed.read()
        self.feed.request_compact_if_behind(self.uploads.in_flight.newest_version)

    def _load(self) -> Load:
        """Return the action that lets the actor play the newest snapshot."""
        newest = self.feed.newest
        assert newest is not None
        is_newer = newest.policy_version != self._loaded_version
        self._loaded_version = newest.policy_version
        return Load(newest if is_newer else None, self.feed.confirmed_at)

    def _collect(self) -> Steps[Rollout]:
        """Return the next rollout; while a client fills it, load newer weights as they come."""
        identity = RolloutIdentity(
            actor=self.config.name,
            incarnation=self.config.incarnation,
            sequence=self.sequence,
            learner_epoch=self.learner_epoch,
        )
        self._schedule.begin_rollout(self.now, self.feed.fetch_seconds)
        self.rollout_ready, self._is_filling = False, True
        while (rollout := (yield Collect(identity))) is None:
            if not (yield from self.wait(lambda: self.rollout_ready, _REFRESH_SECONDS)):
                if self._schedule.is_due(self.now):
                    self._fetch_next()
                self.check()
                yield from self._read()
                yield self._load()
            self.rollout_ready = False
        self._is_filling = False
        self._schedule.end_rollout(self.now)
        self._slow_rollouts = self._slow_rollouts + 1 if self._schedule.rollout_seconds > _SLOW_SECONDS else 0
        return rollout

    def begin_row(self, now: float) -> bool:
        """Note that a row begins; return whether `act_in_rollout` is due.

        No event changes what this method reads: it is no step.
        """
        self._pace.begin_row(now)
        return self.is_due(now)

    def is_due(self, now: float) -> bool:
        """Return whether `act_in_rollout` is due, while no row begins because the rollout waits for somebody else."""
        self._is_fetch_due = self._schedule.is_due(now)
        return self._is_fetch_due or self.leave_by is not None or now >= self.reports.next_at

    def act_in_rollout(self) -> None:
        """Request the snapshot of the next rollout if it is due, and report. Raises as `check_over` does."""
        self.check_over()
        if self._is_fetch_due:
            self._fetch_next()
        self.act(*self.reports.take_due(self.run, self.now))

    def _fetch_next(self) -> None:
        """Request the snapshot of the next rollout, if that can begin at once."""
        if self.uploads.in_flight.has_room_for(2):
            self.feed.fetch()

    def _warn_of_rejections(self) -> None:
        """Warn once that the learner rejects every rollout; it quarantines senders of unfit rollouts much earlier."""
        in_flight = self.uploads.in_flight
        if in_flight.rejections_in_a_row >= _MANY_REJECTIONS and not self._warned_of_rejections:
            self._warned_of_rejections = True
            _logger.warning(
                "the learner rejected the last %d rollouts (%s): the link is too slow; raise training.max_policy_lag "
                "or move the actor closer to the learner",
                _MANY_REJECTIONS,
                in_flight.reason,
            )


def _as_the_learner(spaces: Spaces, welcome: Welcome) -> Spaces:
    """Return an actor's spaces with the components in the learner's order, that of a network's inputs and outputs."""
    if welcome.order is None:  # the learner is an older one
        return spaces
    try:
        return spaces.in_order(welcome.order)
    except ValueError as error:
        raise ActorError(f"the learner's Welcome does not fit the spaces of the environment: {error}") from None


def _check_size(payload: bytes, spec: ActorSpec) -> None:
    """Raise ActorError if the learner does not receive messages of this size: they would be lost in silence."""
    if len(payload) > spec.max_upload_bytes:
        size, most = mebibytes(len(payload), spec.max_upload_bytes)
        raise ActorError(
            f"a rollout of this actor has {size} MiB, and the learner takes at most {most} MiB: set fewer environments "
            "(collection.envs_per_actor, or --envs of daedalus actor) or shorter rollouts (collection.rollout_length), "
            "or raise service.queue_megabytes of the run"
        )
