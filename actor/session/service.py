"""Joins a learner, collects, uploads, follows its snapshots, leaves. The only threads are the transport's."""

import logging
import threading
import time
from dataclasses import dataclass, replace
from typing import Literal

from daedalus.actor.collecting.collector import EnvironmentPlayer, Player
from daedalus.actor.session.learner_queries import LearnerLostError, LearnerQueries, RunOverError
from daedalus.actor.session.snapshot_feed import SnapshotFeed
from daedalus.actor.session.upload_session import UploadSession
from daedalus.policy.acting.runtime import OnnxRuntime, PolicyRuntime
from daedalus.protocol import keys
from daedalus.protocol.codec import encode
from daedalus.protocol.messages import (
    Join,
    RolloutIdentity,
    Snapshot,
    Welcome,
)
from daedalus.protocol.spaces import Spaces
from daedalus.transport.interface import Transport

_logger = logging.getLogger(__name__)

_DOUBT_SECONDS = 1.0  # this long without the snapshot it needs, the actor asks for it
_FIRST_DOUBT_SECONDS = 0.02  # before the first snapshot: the learner may be just about to have one
_SLOW_LINK_SECONDS, _SLOW_LINK_RATE = 0.1, 1 << 20  # an answer took longer than this and so many bytes a second
_IN_VAIN = 20  # rollouts in a row that were rejected: it is worth a word
_SLOW_LINK_WINDOW = 4  # rollouts under way at most, where an answer takes long, unless the run asks for more

LinkChoice = Literal["auto", "lan", "wan"]


@dataclass(frozen=True, slots=True, kw_only=True)
class ActorConfig:
    """Everything that an actor decides for itself."""

    name: str
    incarnation: int
    run: str = keys.ANY_RUN
    environments: int | None = None  # unset: as many as the learner's specification says
    runtime: Literal["onnx", "torch"] = "onnx"
    wrap: str | None = None  # module:function, applied to each environment
    hint: str = ""  # what may be the matter where no learner answers
    link: LinkChoice = "auto"  # wan: snapshots are fetched small and as often as it bears; auto: measured
    timeout: float | None = None  # seconds to look for a learner; unset: for ever


class ActorService:
    """One actor over one transport."""

    def __init__(
        self,
        config: ActorConfig,
        transport: Transport,
        stop: threading.Event,
        player: Player | None = None,
    ) -> None:
        """Environments of its own are played, unless a `player` is given."""
        self._config = config
        self._transport = transport
        self._stop = stop
        self._link = LearnerQueries(transport, config.hint)
        self._upload_session = UploadSession(transport, self._link, stop)
        self._player = player or EnvironmentPlayer(config.environments, config.wrap)
        self._feed = SnapshotFeed(transport, self._link, config.name, self._upload_session.hear)
        self._join = Join(actor=config.name, incarnation=config.incarnation)
        self._runs: set[str] = set()  # in which it is announced
        self._learner_epoch = -1
        self._sequence = 0  # of the next rollout to this learner epoch
        self._told_in_vain = False

    def run(self) -> None:
        """Plays until stopped or until the learner says that the run is over.

        Raises ActorError if the actor is refused, quarantined, or finds no learner within its timeout, and
        EnvironmentSetupError if the environment cannot be made here.
        """
        try:
            while True:
                try:
                    self._take_part(self._find_learner())
                except LearnerLostError:
                    _logger.info("the learner went away; looking for it again")
        except RunOverError as error:
            _logger.info(str(error))
        finally:
            self._player.close()

    def wake(self) -> None:
        """Has a wait look again at what it waits for. From any thread."""
        self._upload_session.wake()

    # ----------------------------------------------------------------------------------------- playing

    def _find_learner(self) -> Welcome:
        welcome = self._link.find(self._config.run, self._join, self._config.timeout, self._stop)
        self._upload_session.found()
        return welcome

    def _take_part(self, welcome: Welcome) -> None:
        """Makes ready to play, is counted in, and plays."""
        spaces, count = self._player.prepare(welcome.spec)
        self._feed.attend(welcome)
        self._announce(welcome.run)
        join = replace(self._join, spaces=spaces, environments=count)
        confirmed = self._link.find(welcome.run, join, self._config.timeout, self._stop)
        if confirmed.learner_epoch != welcome.learner_epoch:
            raise LearnerLostError
        if welcome.learner_epoch == self._learner_epoch:  # the network failed, and not the learner
            self._upload_session.resume()
        else:
            self._upload_session.begin(welcome.run, self._join, welcome.spec.collection.window)
            self._learner_epoch, self._sequence = welcome.learner_epoch, 0
        if self._config.link == "wan" and not welcome.spec.synchronous:
            self._feed.use_compact_snapshots()
        _logger.info(f"joined run {welcome.run!r} as {self._config.name!r}: {count} x {welcome.spec.environment.id}")
        self._play(confirmed, spaces)

    def _announce(self, run: str) -> None:
        if run in self._runs:
            return
        self._runs.add(run)
        self._transport.watch_presence(keys.learner(run), self._upload_session.on_learner)
        self._transport.declare_presence(keys.presence(run, self._config.name, self._config.incarnation))

    def _play(self, welcome: Welcome, spaces: Spaces) -> None:
        player = self._player
        player.begin(self._runtime(welcome, spaces), welcome.spec, welcome.seed)
        self._feed.follow()  # not before the link was measured: what is pushed meanwhile would clog a slow one
        snapshot = self._await_snapshot(newer_than=-1)
        loaded = -1
        while True:
            self._upload_session.await_room()  # before playing: what is played now is of the newest policy
            self._tell_if_in_vain()
            if not welcome.spec.synchronous:
                snapshot = self._newest_snapshot()
            if snapshot.policy_version != loaded:
                player.load(snapshot)
                loaded = snapshot.policy_version
            identity = RolloutIdentity(
                actor=self._config.name,
                incarnation=self._config.incarnation,
                sequence=self._sequence,
                learner_epoch=welcome.learner_epoch,
            )
            began = time.monotonic()
            payload = encode(player.collect(identity, self._upload_session.wait, self._newest_snapshot))
            if self._feed.uses_compact_snapshots:
                window = welcome.spec.collection.window
                self._upload_session.fit_window(time.monotonic() - began, window, max(window, _SLOW_LINK_WINDOW))
            self._upload_session.send(self._sequence, payload)
            self._sequence += 1
            if welcome.spec.synchronous:
                snapshot = self._await_snapshot(newer_than=loaded)

    def _runtime(self, welcome: Welcome, spaces: Spaces) -> PolicyRuntime:
        if self._config.runtime == "torch":
            from daedalus.policy.acting.torch_runtime import TorchRuntime  # an actor has no torch unless it asks for it

            return TorchRuntime(welcome.spec.policy, spaces)
        return OnnxRuntime(self._await_program(welcome))

    def _await_program(self, welcome: Welcome) -> bytes:
        """The program, once the learner has it; how long it takes to come tells how fast the link is."""
        pause = _FIRST_DOUBT_SECONDS
        while True:
            began = time.monotonic()
            program = self._link.program(welcome.run)
            if program is not None:
                break
            self._feed.follow()  # nothing is pushed yet: the first snapshot tells that the program is there too
            self._upload_session.await_word(pause)
            self._feed.read()
            pause = min(2 * pause, _DOUBT_SECONDS)
        if self._config.link == "auto" and not welcome.spec.synchronous:
            self._measure_link(welcome, time.monotonic() - began, len(program[1]))
        return program[1]

    def _measure_link(self, welcome: Welcome, seconds: float, size: int) -> None:
        """Spares a link over which the program took long to come, and did so again: once may be a busy machine."""
        allowed = _SLOW_LINK_SECONDS + size / _SLOW_LINK_RATE
        for _ in range(2):
            if seconds <= allowed:
                return
            began = time.monotonic()
            self._link.program(welcome.run)
            seconds = time.monotonic() - began
        if seconds > allowed:
            _logger.info(f"a slow link ({size:,} bytes took {seconds:.2f} s): weights come small, and less often")
            self._feed.use_compact_snapshots()

    def _tell_if_in_vain(self) -> None:
        """Says once that nothing is taken; an actor that sends what is unfit is quarantined long before."""
        refused, reason = self._upload_session.refusals
        if refused >= _IN_VAIN and not self._told_in_vain:
            self._told_in_vain = True
            _logger.info(
                f"the learner rejected the last {_IN_VAIN} rollouts ({reason}): the way there is "
                "too slow for it; start it with a higher --set training.max_policy_lag=..., or this actor nearer to it"
            )

    # --------------------------------------------------------------------------------------- snapshots

    def _await_snapshot(self, newer_than: int) -> Snapshot:
        """Waits for a snapshot newer than a version; asks for it when in doubt.

        Returns early if the rollout that was to bring it was rejected: another must take its place.
        """
        first = newer_than < 0

        def arrived() -> bool:
            self._feed.read()
            return self._feed.newest is not None and self._feed.newest.policy_version > newer_than

        pause = _FIRST_DOUBT_SECONDS if first else _DOUBT_SECONDS
        talk = self._upload_session
        while not talk.wait(lambda: arrived() or (talk.must_replace and not first), pause):
            pause = min(2 * pause, _DOUBT_SECONDS)
            self._feed.ask()
        talk.replace()
        assert self._feed.newest is not None
        return self._feed.newest

    def _newest_snapshot(self) -> Snapshot:
        """What has come by now; asks for what answers tell of and did not come."""
        self._feed.read()
        self._upload_session.check()
        self._feed.keep_up(self._upload_session.newest_version)
        assert self._feed.newest is not None
        return self._feed.newest
