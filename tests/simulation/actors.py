"""An actor's process: the real session engine in virtual time, with rollouts that are made without environments."""

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np

from daedalus.actor.errors import ActorError, NameInUseError
from daedalus.actor.session.actor_config import ActorConfig, LinkChoice
from daedalus.actor.session.conversation import (
    Ask,
    AtOnce,
    DeclarePresence,
    Query,
    Reopen,
    RunOverError,
    Steps,
    Subscribe,
    Unsubscribe,
    Wait,
    WatchPresence,
    WithdrawPresence,
    Work,
)
from daedalus.actor.session.session_engine import ActorSession, Begin, Collect, Encode, Load, Prepare
from daedalus.protocol.codec import encode
from daedalus.protocol.messages import Snapshot
from daedalus.protocol.spaces import ArraySpace, DiscreteSpace, Spaces
from daedalus.protocol.uploads import Rollout, RolloutIdentity
from daedalus.transport.interface import Declaration, Inbox, TransportError

from .kernel import Kernel
from .ledger import Ledger
from .link import Link
from .network import Network
from .process import Channel, Process

_SPACES = Spaces(
    observations={"observation": ArraySpace(shape=(4,), dtype="float32")},
    actions={"action": DiscreteSpace(counts=(2,))},
)
_FALSE = np.zeros((1, 1), np.bool_)
_ZERO = np.zeros((1, 1), np.float32)
_KEPT = 2  # rollouts that a client keeps while it cannot send
_PREPARE_SECONDS = 0.1
_EPOCH = 1000.0  # the time of an actor's clock at the start


@dataclass(frozen=True, slots=True, kw_only=True)
class ActorSettings:
    """What distinguishes one actor from another."""

    kind: Literal["environments", "client"]
    link: LinkChoice
    run: str  # its name, or * for any
    collect_seconds: float  # for one rollout
    poll_seconds: float  # how soon it notices a stop


@dataclass(slots=True, eq=False)
class ActorProcess:
    """One incarnation of an actor: performs the actions of its session, and brings it events."""

    kernel: Kernel
    network: Network
    ledger: Ledger
    name: str
    incarnation: int
    settings: ActorSettings
    on_end: Callable[["ActorProcess"], None]
    process: Process = field(init=False)
    link: Link = field(init=False)
    session: ActorSession = field(init=False)
    stopping: bool = False
    hang_seconds: float = 0.0  # how much longer the next rollout takes
    hangs_until: float = 0.0  # when its environment goes on
    is_disturbed: bool = False  # whether it was frozen or hung, so that it may end late
    outcome: str = ""  # why the process ended
    _steps: Steps[Any] = field(init=False)
    _channel: Channel = field(init=False)  # of its own timers
    _inboxes: dict[str, Inbox] = field(default_factory=dict)
    _watched: set[str] = field(default_factory=set)
    _declared: dict[str, Declaration] = field(default_factory=dict)
    _waits: int = 0  # how many waits have begun; a timer of an earlier one is ignored
    _is_waiting: bool = False
    _has_event: bool = False  # since the last step
    _snapshot: Snapshot | None = None
    _full: int = 0  # rollouts that a client has filled

    def start(self) -> None:
        """Start the process."""
        settings = self.settings
        self.process = Process(self.kernel, f"{self.name}.{self.incarnation}", has_threads=False)
        self.link = Link(self.network, self.process)
        self._channel = Channel(self.process, "timer")
        self.session = ActorSession(
            ActorConfig(name=self.name, incarnation=self.incarnation, run=settings.run, link=settings.link)
        )
        self._steps = self.session.play()
        self.kernel.log("start", self.process.name, settings.kind, settings.link)
        self._after(0.0, self._advance)
        if settings.kind == "client":
            self._after(self._lasts(settings.collect_seconds), self._user_acts)

    def kill(self) -> None:
        """End the process as SIGKILL does."""
        self.kernel.log("kill", self.process.name)
        self.link.process_killed()
        self._end("killed")

    def _end(self, outcome: str) -> None:
        self.process.kill()
        self.kernel.log("end", self.process.name, outcome)
        self.outcome = outcome
        self.on_end(self)

    def _leave(self, error: Exception) -> None:
        """End the process as `daedalus actor` does when its service raises."""
        if isinstance(error, RunOverError):
            outcome = "run over" if error.finished else "stopped"
            is_right = self.ledger.is_finished if error.finished else self.stopping
            self.ledger.require(is_right, self.process.name, "ends, but was not stopped, and the run is not over")
        elif isinstance(error, NameInUseError):
            outcome = "name in use"
        else:
            outcome = f"error: {error}"
            self.ledger.require(False, self.process.name, "gives up:", error)
        self.link.close()
        self._end(outcome)

    # ------------------------------------------------------------------------------------------------- time

    @property
    def _now(self) -> float:
        return _EPOCH + self.kernel.now

    def _after(self, seconds: float, call: Callable[..., None], *arguments: Any) -> None:
        self.kernel.after(seconds, self._channel.deliver, call, *arguments)

    def _lasts(self, seconds: float) -> float:
        """Return how long something takes that should take so many seconds, in an environment that may hang."""
        hang, self.hang_seconds = self.hang_seconds, 0.0
        lasts = seconds * self.kernel.random.uniform(0.5, 1.5) + hang
        if hang:
            self.hangs_until = self.kernel.now + lasts
        return lasts

    # ------------------------------------------------------------------------------------------------ events

    def _event(self, event: Callable[..., None], *arguments: Any) -> None:
        """Let an event come to the session; one that waits goes on."""
        self.session.now = self._now
        event(*arguments)
        self._has_event = True
        self._act()
        if self._is_waiting:
            self._advance()

    def _on_news(self) -> None:
        self._event(lambda: None)

    def _on_presence(self, _key: str, present: bool) -> None:
        self._event(self.session.presence_changed, present)

    def _user_acts(self) -> None:
        """Fill a rollout, as the loop of a client's user does."""
        self._after(self._lasts(self.settings.collect_seconds), self._user_acts)
        if self._snapshot is not None:
            self._full = min(self._full + 1, _KEPT)
            self._event(setattr, self.session, "rollout_ready", True)

    # ------------------------------------------------------------------------------------------------- steps

    def _advance(self, came: Any = None) -> None:
        """Let the session go on with what came of its action, until the next one takes time."""
        takes_time = self._is_waiting = False
        while not takes_time:
            action = self._step(self._steps.send, came)
            if self.outcome:
                return
            came, takes_time = self._perform(action)

    def _step(self, step: Callable[..., Any], *arguments: Any) -> Any:
        """Make a step of the session; if it raises, end the process."""
        try:
            if self.stopping:
                raise RunOverError("stopped")
            self.session.now, self._has_event = self._now, False
            for key, inbox in self._inboxes.items():
                data = inbox.take()
                if data is not None:
                    self.session.received(key, data)
            action = step(*arguments)
            self._act()
        except (RunOverError, ActorError) as error:
            self._leave(error)
            return None
        return action

    def _perform(self, action: Any) -> tuple[Any, bool]:
        """Perform an action; return what came of it, and whether that comes only later, by `_advance`."""
        match action:
            case Ask(key, payload, timeout):
                self._ask(key, payload, timeout)
            case Wait(until):
                return None, not self._has_event and self._wait(until)
            case Work(call):
                return call(), False
            case Reopen():
                self.link.reopen_later(self._advance)
            case Prepare():
                self._after(self._lasts(_PREPARE_SECONDS), self._advance, (_SPACES, 1))
            case Begin():
                assert action.program
                self._snapshot = None
                return None, False
            case Load(snapshot):
                self._load(snapshot)
                return None, False
            case Collect(identity):
                return self._collect(identity)
            case Encode(rollout):
                return encode(rollout), False
        return None, True

    def _ask(self, key: str, payload: bytes, timeout: float) -> None:
        try:
            self.link.ask(key, payload, timeout, self._advance)
        except TransportError:
            self._after(0.0, self._advance, [])

    def _wait(self, until: float | None) -> bool:
        self._is_waiting, self._waits = True, self._waits + 1
        seconds = self.settings.poll_seconds
        seconds = seconds if until is None else min(seconds, max(until - self._now, 0.0))
        self._after(seconds, self._end_wait, self._waits)
        return True

    def _end_wait(self, number: int) -> None:
        if self._is_waiting and number == self._waits:
            self._advance()

    def _act(self) -> None:
        """Perform what is to be done at once."""
        for action in self.session.take_actions():
            self._perform_at_once(action)

    def _perform_at_once(self, action: AtOnce) -> None:
        match action:
            case Query(key, payload, timeout, on_answer):
                try:
                    self.link.query_async(
                        key,
                        payload,
                        timeout=timeout,
                        on_answer=lambda data: self._event(on_answer, data, self._now),
                    )
                except TransportError:
                    self._has_event = True
                    on_answer(None, self._now)
            case Subscribe(key):
                if key not in self._inboxes:
                    self._inboxes[key] = self.link.subscribe(key, self._on_news)
            case Unsubscribe(key):
                self._inboxes.pop(key).close()
            case WatchPresence(key):
                if key not in self._watched:
                    self.link.watch_presence(key, self._on_presence)
                    self._watched.add(key)
            case DeclarePresence(key):
                if key not in self._declared:
                    self._declared[key] = self.link.declare_presence(key)
            case WithdrawPresence(key):
                if key in self._declared:
                    self._declared.pop(key).close()

    # ---------------------------------------------------------------------------------------------- rollouts

    def _load(self, snapshot: Snapshot | None) -> None:
        if snapshot is None:
            return
        previous, self._snapshot = self._snapshot, snapshot
        older = previous is not None and snapshot.policy_version < previous.policy_version
        self.ledger.require(not older, "an older policy version is loaded after a newer one")

    def _collect(self, identity: RolloutIdentity) -> tuple[Rollout | None, bool]:
        """Make a rollout of two rows, or take one that a client has filled."""
        if self.settings.kind == "client":
            filled, self._full = self._full, max(self._full - 1, 0)
            return (self._rollout(identity) if filled else None), False
        seconds = self._lasts(self.settings.collect_seconds)
        self._after(seconds / 2, self._make_row)
        self._after(seconds, self._end_rollout, identity)
        return None, True

    def _make_row(self) -> None:
        session = self.session
        self._step(session.act_in_rollout if session.begin_row(self._now) else session.check_over)

    def _end_rollout(self, identity: RolloutIdentity) -> None:
        if not self.outcome:
            self._advance(self._rollout(identity))

    def _rollout(self, identity: RolloutIdentity) -> Rollout:
        snapshot, ledger = self._snapshot, self.ledger
        assert snapshot is not None
        ledger.used(snapshot, identity.learner_epoch)
        frames = np.zeros((2, 1, 4), np.float32)
        frames[0, 0] = [*snapshot.weights["w"], ledger.collect(identity)]
        return Rollout(
            identity=identity,
            policy_version=snapshot.policy_version,
            frames={"observation": frames},
            initial_state=np.zeros((1, 0), np.float32),
            actions={"action": np.zeros((1, 1, 1), np.int64)},
            masks={},
            behaviour_log_probs=_ZERO,
            rewards=_ZERO,
            terminated=_FALSE,
            truncated=_FALSE,
            valid=~_FALSE,
            episode_returns=np.zeros(0, np.float32),
            episode_lengths=np.zeros(0, np.int32),
        )
