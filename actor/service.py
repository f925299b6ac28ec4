"""Joins a learner, collects, uploads, follows its snapshots, leaves. The only threads are the transport's."""

import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

from actor.collector import Collector
from actor.environments import VectorEnvironment, make_environments
from actor.learner_link import ActorError, LearnerLink, OverError
from actor.uploader import Uploader
from policy.runtime import OnnxRuntime, PolicyRuntime
from protocol import keys
from protocol.codec import Limits, ProtocolError, decode, encode
from protocol.messages import (
    Acknowledgement,
    Farewell,
    Join,
    Message,
    RolloutIdentity,
    Snapshot,
    Welcome,
)
from protocol.spec import EnvironmentSpec, Spaces
from protocol.transport import Inbox, Transport, TransportError

_ANSWER_LIMITS = Limits(max_bytes=0, max_header_bytes=16 << 10, max_arrays=0)
_ACKNOWLEDGE_SECONDS = 30.0  # a saturated learner answers late
_DOUBT_SECONDS = 1.0  # this long without the snapshot it needs, the actor asks for it
_FIRST_DOUBT_SECONDS = 0.02  # before the first snapshot: the learner may be just about to have one
_HEARTBEAT_SECONDS = 0.2  # how soon a wait notices that it should stop
_SILENCE_SECONDS = 10.0  # nothing heard for so long, the learner is asked whether it is there


class _LearnerLostError(Exception):
    """The learner went away, or lives another life; join again."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ActorConfig:
    """Everything that an actor decides for itself."""

    name: str
    incarnation: int
    run: str = keys.ANY_RUN
    environments: int | None = None  # unset: as many as the learner's specification says
    runtime: Literal["onnx", "torch"] = "onnx"
    wrap: str | None = None  # module:function, applied to each environment
    timeout: float | None = None  # seconds to look for a learner; unset: for ever


class ActorService:
    """One actor over one transport."""

    def __init__(
        self, config: ActorConfig, transport: Transport, stop: threading.Event, say: Callable[[str], None]
    ) -> None:
        self._config = config
        self._transport = transport
        self._stop = stop
        self._say = say
        self._link = LearnerLink(transport, say)
        self._changed = threading.Condition()  # guards what the transport's threads touch: the next three
        self._uploader = Uploader(window=1)
        self._learner_left = False
        self._heard_at = 0.0  # when the learner last said anything
        self._run = ""  # the one that it takes part in
        self._inboxes: dict[str, Inbox] = {}  # by run
        self._made: tuple[EnvironmentSpec, VectorEnvironment] | None = None
        self._snapshot: Snapshot | None = None  # the newest of this learner epoch
        self._news_at = 0.0  # when it came
        self._learner_epoch = -1
        self._sequence = 0  # of the next rollout to this learner epoch

    def run(self) -> None:
        """Plays until stopped or until the learner says that the run is over.

        Raises ActorError if the actor is refused, quarantined, or finds no learner within its timeout, and
        UnplayableError if the environment cannot be made here.
        """
        try:
            while True:
                try:
                    self._take_part(self._find_learner())
                except _LearnerLostError:
                    self._say("the learner went away; looking for it again")
        except OverError as error:
            self._say(str(error))
        finally:
            if self._made is not None:
                self._made[1].close()

    # ----------------------------------------------------------------------------------------- playing

    def _find_learner(self) -> Welcome:
        join = Join(actor=self._config.name, incarnation=self._config.incarnation)
        welcome = self._link.find(self._config.run, join, self._config.timeout, self._stop)
        with self._changed:
            self._learner_left, self._heard_at = False, time.monotonic()
        return welcome

    def _take_part(self, welcome: Welcome) -> None:
        """Makes the environments, is counted in, and plays."""
        self._run = welcome.run
        environments = self._environments(welcome.spec.environment, welcome)
        self._follow(welcome.run)
        confirmed = self._link.join(
            welcome.run,
            Join(
                actor=self._config.name,
                incarnation=self._config.incarnation,
                spaces=environments.spaces,
                environments=environments.count,
            ),
        )
        if confirmed is None or confirmed.learner_epoch != welcome.learner_epoch:
            raise _LearnerLostError
        with self._changed:
            if welcome.learner_epoch == self._learner_epoch:  # the network failed, and not the learner
                self._uploader.send_again()
            else:
                self._uploader = Uploader(window=welcome.spec.collection.window)
                self._learner_epoch, self._sequence = welcome.learner_epoch, 0
        self._snapshot = None
        self._say(
            f"joined run {welcome.run!r} as {self._config.name!r}: {environments.count} x {welcome.spec.environment.id}"
        )
        self._play(confirmed, environments)

    def _environments(self, spec: EnvironmentSpec, welcome: Welcome) -> VectorEnvironment:
        """The environments of `spec`; those of an earlier join if they are the same."""
        if self._made is not None and self._made[0] != spec:
            self._made[1].close()
            self._made = None
        if self._made is None:
            count = self._config.environments or welcome.spec.collection.envs_per_actor
            self._made = spec, make_environments(spec, count, wrap=self._config.wrap)
        return self._made[1]

    def _follow(self, run: str) -> None:
        if run in self._inboxes:
            return
        self._inboxes[run] = self._transport.follow(keys.snapshots(run), self._notify)
        self._transport.watch(keys.learner(run), self._on_learner)
        self._transport.announce(keys.presence(run, self._config.name))

    def _play(self, welcome: Welcome, environments: VectorEnvironment) -> None:
        self._await_snapshot(welcome, newer_than=-1)
        assert self._snapshot is not None
        collector = Collector(
            environments,
            self._runtime(welcome, self._snapshot, environments.spaces),
            welcome.spec.environment,
            rollout_length=welcome.spec.collection.rollout_length,
            seed=welcome.seed,
        )
        loaded = -1
        while True:
            self._wait(lambda: self._uploader.has_room)  # before playing: what is played now is of the newest policy
            if not welcome.spec.synchronous:
                self._read_inbox(welcome)
                self._doubt(welcome)
            if self._snapshot.policy_version != loaded:
                collector.load(self._snapshot.weights)
                loaded = self._snapshot.policy_version
            identity = RolloutIdentity(
                actor=self._config.name,
                incarnation=self._config.incarnation,
                sequence=self._sequence,
                learner_epoch=welcome.learner_epoch,
            )
            payload = encode(collector.collect(identity, loaded))
            with self._changed:
                self._uploader.add(self._sequence, payload)
            self._send_due()
            self._sequence += 1
            if welcome.spec.synchronous:
                self._await_snapshot(welcome, newer_than=loaded)

    def _runtime(self, welcome: Welcome, snapshot: Snapshot, spaces: Spaces) -> PolicyRuntime:
        if self._config.runtime == "torch":
            from policy.torch_runtime import TorchRuntime  # an actor has no torch unless it asks for it

            return TorchRuntime(welcome.spec.policy, spaces)
        model = self._link.program(welcome.run, snapshot.program)
        if model is not None:
            return OnnxRuntime(model)
        raise _LearnerLostError

    # --------------------------------------------------------------------------------------- snapshots

    def _await_snapshot(self, welcome: Welcome, newer_than: int) -> None:
        """Waits for a snapshot newer than a version; asks for it when in doubt.

        Returns early if the rollout that was to bring it was rejected: another must take its place.
        """
        first = newer_than < 0

        def arrived() -> bool:
            self._read_inbox(welcome)
            return self._snapshot is not None and self._snapshot.policy_version > newer_than

        pause = _FIRST_DOUBT_SECONDS if first else _DOUBT_SECONDS
        while not self._wait(lambda: arrived() or (self._uploader.must_replace and not first), pause):
            pause = min(2 * pause, _DOUBT_SECONDS)
            self._ask_news(welcome)
        with self._changed:
            self._uploader.must_replace = False

    def _doubt(self, welcome: Welcome) -> None:
        """Asks for the newest snapshot if answers tell of one that was pushed and did not arrive."""
        assert self._snapshot is not None
        missed = self._uploader.newest_version > self._snapshot.policy_version
        if missed and time.monotonic() > self._news_at + _DOUBT_SECONDS:
            self._news_at = time.monotonic()
            self._ask_news(welcome)

    def _ask_news(self, welcome: Welcome) -> None:
        for message in self._link.newest(welcome.run):
            self._take_news(welcome, message)

    def _read_inbox(self, welcome: Welcome) -> None:
        news = self._inboxes[welcome.run].take()
        message = None if news is None else self._link.decode(news)
        if message is not None:
            self._take_news(welcome, message)
        self._check()

    def _take_news(self, welcome: Welcome, news: Message) -> None:
        if isinstance(news, Farewell) and news.learner_epoch == welcome.learner_epoch:
            raise OverError(f"the run is over: {news.reason}")
        if not isinstance(news, Snapshot):
            return
        if news.learner_epoch != welcome.learner_epoch:
            raise _LearnerLostError
        if self._snapshot is None or news.policy_version > self._snapshot.policy_version:
            self._snapshot, self._news_at = news, time.monotonic()

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
            if not self._link.newest(self._run):
                raise _LearnerLostError
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
            raise _LearnerLostError

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
