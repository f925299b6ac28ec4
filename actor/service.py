"""Joins a learner, collects, uploads, follows its snapshots, leaves. The only threads are the transport's."""

import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Literal

from actor.learner_link import ActorError, LearnerLink, LearnerLostError, OverError
from actor.player import EnvironmentPlayer, Player
from actor.snapshot_feed import SnapshotFeed
from actor.uploader import Uploader
from policy.runtime import OnnxRuntime, PolicyRuntime
from protocol import keys
from protocol.codec import Limits, ProtocolError, decode, encode
from protocol.messages import (
    Acknowledgement,
    Join,
    RolloutIdentity,
    Snapshot,
    Welcome,
)
from protocol.spec import Spaces
from protocol.transport import Transport, TransportError

_ANSWER_LIMITS = Limits(max_bytes=0, max_header_bytes=16 << 10, max_arrays=0)
_ACKNOWLEDGE_SECONDS = 30.0  # a saturated learner answers late
_DOUBT_SECONDS = 1.0  # this long without the snapshot it needs, the actor asks for it
_FIRST_DOUBT_SECONDS = 0.02  # before the first snapshot: the learner may be just about to have one
_HEARTBEAT_SECONDS = 0.2  # how soon a wait notices that it should stop
_SILENCE_SECONDS = 10.0  # nothing heard for so long, the learner is asked whether it is there
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
        say: Callable[[str], None],
        player: Player | None = None,
    ) -> None:
        """Environments of its own are played, unless a `player` is given."""
        self._config = config
        self._transport = transport
        self._stop = stop
        self._say = say
        self._link = LearnerLink(transport, say, config.hint)
        self._changed = threading.Condition()  # guards what the transport's threads touch: the next three
        self._uploader = Uploader(window=1)
        self._learner_left = False
        self._heard_at = 0.0  # when the learner last said anything
        self._player = player or EnvironmentPlayer(config.environments, config.wrap)
        self._feed = SnapshotFeed(transport, self._link, config.name, self._notify)
        self._join = Join(actor=config.name, incarnation=config.incarnation)
        self._runs: set[str] = set()  # in which it is announced
        self._run = ""  # the one that it takes part in
        self._learner_epoch = -1
        self._sequence = 0  # of the next rollout to this learner epoch
        self._told_in_vain = False

    def run(self) -> None:
        """Plays until stopped or until the learner says that the run is over.

        Raises ActorError if the actor is refused, quarantined, or finds no learner within its timeout, and
        UnplayableError if the environment cannot be made here.
        """
        try:
            while True:
                try:
                    self._take_part(self._find_learner())
                except LearnerLostError:
                    self._say("the learner went away; looking for it again")
        except OverError as error:
            self._say(str(error))
        finally:
            self._player.close()

    def wake(self) -> None:
        """Has a wait look again at what it waits for. From any thread."""
        with self._changed:
            self._changed.notify_all()

    # ----------------------------------------------------------------------------------------- playing

    def _find_learner(self) -> Welcome:
        welcome = self._link.find(self._config.run, self._join, self._config.timeout, self._stop)
        with self._changed:
            self._learner_left, self._heard_at = False, time.monotonic()
        return welcome

    def _take_part(self, welcome: Welcome) -> None:
        """Makes ready to play, is counted in, and plays."""
        self._run = welcome.run
        spaces, count = self._player.prepare(welcome.spec)
        self._feed.attend(welcome)
        self._announce(welcome.run)
        join = replace(self._join, spaces=spaces, environments=count)
        confirmed = self._link.find(welcome.run, join, self._config.timeout, self._stop)
        if confirmed.learner_epoch != welcome.learner_epoch:
            raise LearnerLostError
        with self._changed:
            if welcome.learner_epoch == self._learner_epoch:  # the network failed, and not the learner
                self._uploader.send_again()
            else:
                self._uploader = Uploader(window=welcome.spec.collection.window)
                self._learner_epoch, self._sequence = welcome.learner_epoch, 0
        if self._config.link == "wan" and not welcome.spec.synchronous:
            self._feed.spare_the_link()
        self._say(f"joined run {welcome.run!r} as {self._config.name!r}: {count} x {welcome.spec.environment.id}")
        self._play(confirmed, spaces)

    def _announce(self, run: str) -> None:
        if run in self._runs:
            return
        self._runs.add(run)
        self._transport.watch(keys.learner(run), self._on_learner)
        self._transport.announce(keys.presence(run, self._config.name, self._config.incarnation))

    def _play(self, welcome: Welcome, spaces: Spaces) -> None:
        player = self._player
        player.begin(self._runtime(welcome, spaces), welcome.spec, welcome.seed)
        self._feed.follow()  # not before the link was measured: what is pushed meanwhile would clog a slow one
        snapshot = self._await_snapshot(newer_than=-1)
        loaded = -1
        while True:
            self._wait(lambda: self._uploader.has_room)  # before playing: what is played now is of the newest policy
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
            payload = encode(player.collect(identity, self._wait, self._newest_snapshot))
            with self._changed:
                if self._feed.spares_the_link:
                    window = welcome.spec.collection.window
                    self._uploader.fit_window(time.monotonic() - began, window, max(window, _SLOW_LINK_WINDOW))
                self._uploader.add(self._sequence, payload)
            self._send_due()
            self._sequence += 1
            if welcome.spec.synchronous:
                snapshot = self._await_snapshot(newer_than=loaded)

    def _runtime(self, welcome: Welcome, spaces: Spaces) -> PolicyRuntime:
        if self._config.runtime == "torch":
            from policy.torch_runtime import TorchRuntime  # an actor has no torch unless it asks for it

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
            heard_at = self._heard_at
            self._wait(lambda heard_at=heard_at: self._heard_at > heard_at, pause)
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
            self._say(f"a slow link ({size:,} bytes took {seconds:.2f} s): weights come small, and less often")
            self._feed.spare_the_link()

    def _tell_if_in_vain(self) -> None:
        """Says once that nothing is taken; an actor that sends what is unfit is quarantined long before."""
        if self._uploader.refused_in_a_row >= _IN_VAIN and not self._told_in_vain:
            self._told_in_vain = True
            self._say(
                f"the learner rejected the last {_IN_VAIN} rollouts ({self._uploader.reason}): the way there is "
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
        while not self._wait(lambda: arrived() or (self._uploader.must_replace and not first), pause):
            pause = min(2 * pause, _DOUBT_SECONDS)
            self._feed.ask()
        with self._changed:
            self._uploader.must_replace = False
        assert self._feed.newest is not None
        return self._feed.newest

    def _newest_snapshot(self) -> Snapshot:
        """What has come by now; asks for what answers tell of and did not come."""
        self._feed.read()
        self._check()
        self._feed.keep_up(self._uploader.newest_version)
        assert self._feed.newest is not None
        return self._feed.newest

    # ----------------------------------------------------------------------------------------- waiting

    def _wait(self, ready: Callable[[], bool], timeout: float | None = None) -> bool:
        """Waits until `ready`, sending what falls due meanwhile; False if `timeout` seconds passed first."""
        deadline = None if timeout is None else time.monotonic() + timeout
        while True:
            self._send_due()
            self._break_silence()
            with self._changed:
                self._check()
                if ready():
                    return True
                now = time.monotonic()
                if deadline is not None and now >= deadline:
                    return False
                due = self._uploader.next_due()
                until = min(t for t in (deadline, due, now + _HEARTBEAT_SECONDS) if t is not None)
                self._changed.wait(max(until - now, 0.0))

    def _break_silence(self) -> None:
        """Raises if nothing was heard for long, and nothing is to be heard: then a session is dead that seems alive."""
        if time.monotonic() > self._heard_at + _SILENCE_SECONDS:
            if not self._link.is_there(self._run, self._join):
                raise LearnerLostError
            with self._changed:
                self._heard_at = time.monotonic()

    def _check(self) -> None:
        """Raises if there is a reason to stop playing."""
        if self._stop.is_set():
            raise OverError("stopped")
        if self._uploader.over == "quarantined":
            raise ActorError(
                f"the learner takes nothing more of this actor: {self._uploader.reason}; mend that and start it again"
            )
        if self._uploader.over == "finished":
            raise OverError("the run is over")
        if self._learner_left or self._uploader.over == "fenced":
            raise LearnerLostError

    def _send_due(self) -> None:
        key = keys.rollouts(self._run, self._config.name)
        uploader = self._uploader
        with self._changed:
            due = uploader.due(time.monotonic())
        for sequence, payload in due:
            try:
                self._transport.send(
                    key,
                    payload,
                    timeout=_ACKNOWLEDGE_SECONDS,
                    on_answer=lambda answer, sequence=sequence: self._on_answer(uploader, sequence, answer),
                )
            except TransportError:
                self._on_answer(uploader, sequence, None)

    # ------------------------------------------------------------------ called on the transport's threads

    def _on_answer(self, uploader: Uploader, sequence: int, data: bytes | None) -> None:
        answer = None
        if data is not None:
            try:
                answer = decode(data, _ANSWER_LIMITS)
            except ProtocolError:
                answer = None
        with self._changed:
            if data is not None:
                self._heard_at = time.monotonic()
            uploader.answered(sequence, answer if isinstance(answer, Acknowledgement) else None, time.monotonic())
            self._changed.notify_all()

    def _on_learner(self, _key: str, present: bool) -> None:
        with self._changed:
            # Whoever is there next may be another: to be asked.
            self._learner_left = self._learner_left or not present
            self._changed.notify_all()

    def _notify(self) -> None:
        with self._changed:
            self._heard_at = time.monotonic()
            self._changed.notify_all()
