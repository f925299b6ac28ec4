"""An actor's process: the real actor service, with collectors that make rollouts without environments."""

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from daedalus.actor.errors import ActorError, NameInUseError
from daedalus.actor.session.actor_config import ActorConfig, LinkChoice
from daedalus.actor.session.actor_service import ActorService
from daedalus.policy.acting.runtime import PolicyRuntime
from daedalus.protocol.messages import Snapshot
from daedalus.protocol.spaces import ArraySpace, DiscreteSpace, Spaces
from daedalus.protocol.spec import ActorSpec
from daedalus.protocol.uploads import Rollout, RolloutIdentity

from .kernel import Kernel
from .ledger import Ledger
from .link import Link
from .network import Network
from .primitives import Event
from .process import Process

_SPACES = Spaces(
    observations={"observation": ArraySpace(shape=(4,), dtype="float32")},
    actions={"action": DiscreteSpace(counts=(2,))},
)
_FALSE = np.zeros((1, 1), np.bool_)
_ZERO = np.zeros((1, 1), np.float32)
_KEPT = 2  # rollouts that a client keeps while it cannot send


class Runtime:
    """In place of OnnxRuntime: a policy that is never run."""

    def __init__(self, model: bytes, *_: object) -> None:
        assert model


@dataclass(frozen=True, slots=True, kw_only=True)
class ActorSettings:
    """What distinguishes one actor from another."""

    kind: Literal["environments", "client"]
    link: LinkChoice
    run: str  # its name, or * for any
    collect_seconds: float  # for one rollout


class ScriptedCollector:
    """A Collector whose rollouts carry a number of their own and the weights that they were made with."""

    def __init__(self, actor: "ActorProcess") -> None:
        self._actor = actor
        self._snapshot: Snapshot | None = None

    def prepare(self, spec: ActorSpec) -> tuple[Spaces, int]:
        self._actor.pass_time(0.1)
        return _SPACES, 1

    def begin(self, runtime: PolicyRuntime, spec: ActorSpec, seed: int, epsilon: float = 0.0) -> None:
        self._snapshot = None

    def load(self, snapshot: Snapshot) -> None:
        previous = self._snapshot
        older = previous is not None and snapshot.policy_version < previous.policy_version
        self._actor.ledger.require(not older, "an older policy version is loaded after a newer one")
        self._snapshot = snapshot

    def confirm(self, at: float) -> None:
        pass

    def has_rollout(self) -> bool:
        return True

    def collect(self, identity: RolloutIdentity, *_: object) -> Rollout | None:
        self._actor.pass_time(self._actor.settings.collect_seconds)
        return self._rollout(identity)

    def close(self) -> None:
        pass

    def _rollout(self, identity: RolloutIdentity) -> Rollout:
        snapshot, ledger = self._snapshot, self._actor.ledger
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


class ScriptedClient(ScriptedCollector):
    """A Collector whose rollouts are made on another thread, as those of a Client are."""

    _full = 0

    def act(self) -> None:
        """Make rollouts for ever. On a thread of its own."""
        while True:
            self._actor.pass_time(self._actor.settings.collect_seconds)
            if self._snapshot is not None:
                self._full = min(self._full + 1, _KEPT)
                self._actor.service.wake()

    def has_rollout(self) -> bool:
        return self._full > 0

    def collect(self, identity: RolloutIdentity, *_: object) -> Rollout | None:
        if not self._full:
            return None
        self._full -= 1
        return self._rollout(identity)


@dataclass(slots=True, eq=False)
class ActorProcess:
    """One incarnation of an actor."""

    kernel: Kernel
    network: Network
    ledger: Ledger
    name: str
    incarnation: int
    settings: ActorSettings
    on_end: Callable[["ActorProcess"], None]
    process: Process = field(init=False)
    link: Link = field(init=False)
    stop: Event = field(init=False)
    service: ActorService = field(init=False)
    hang_seconds: float = 0.0  # how much longer the next rollout takes
    hangs_until: float = 0.0  # when its environment goes on
    is_disturbed: bool = False  # whether it was frozen or hung, so that it may end late
    outcome: str = ""  # why the process ended

    def start(self) -> None:
        """Start the process."""
        settings = self.settings
        self.process = Process(self.kernel, f"{self.name}.{self.incarnation}")
        self.link = Link(self.network, self.process)
        self.stop = Event(self.kernel)
        config = ActorConfig(name=self.name, incarnation=self.incarnation, run=settings.run, link=settings.link)
        collector = ScriptedClient(self) if settings.kind == "client" else ScriptedCollector(self)
        self.service = ActorService(config, self.link, self.stop, collector)  # type: ignore[arg-type]
        self.kernel.log("start", self.process.name, settings.kind, settings.link)
        self.kernel.spawn(self.process, "main", self._main)
        if isinstance(collector, ScriptedClient):
            self.kernel.spawn(self.process, "user", collector.act)

    def kill(self) -> None:
        """End the process as SIGKILL does."""
        self.kernel.log("kill", self.process.name)
        self.process.kill()
        self.link.process_killed()
        self._end("killed")

    def pass_time(self, seconds: float) -> None:
        """Let an environment take its time."""
        hang, self.hang_seconds = self.hang_seconds, 0.0
        lasts = seconds * self.kernel.random.uniform(0.5, 1.5) + hang
        if hang:
            self.hangs_until = self.kernel.now + lasts
        self.kernel.sleep(lasts)

    def _main(self) -> None:
        """Do what `daedalus actor` does."""
        try:
            finished = self.service.run()
            outcome = "run over" if finished else "stopped"
            is_right = self.ledger.is_finished if finished else self.stop.is_set()
            self.ledger.require(is_right, self.process.name, "ends, but was not stopped, and the run is not over")
        except NameInUseError:
            outcome = "name in use"
        except ActorError as error:
            outcome = f"error: {error}"
            self.ledger.require(False, self.process.name, "gives up:", error)
        self.link.close()
        self.process.kill()  # the user's thread of a client
        self._end(outcome)

    def _end(self, outcome: str) -> None:
        self.kernel.log("end", self.process.name, outcome)
        self.outcome = outcome
        self.on_end(self)
