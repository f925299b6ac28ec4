"""An actor's process: the real actor service, with a collector that makes rollouts without environments."""

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from daedalus.actor.session.learner_queries import ActorError, NameInUseError
from daedalus.actor.session.service import ActorConfig, ActorService
from daedalus.policy.acting.runtime import PolicyRuntime
from daedalus.protocol.messages import Rollout, RolloutIdentity, Snapshot
from daedalus.protocol.spaces import ArraySpace, DiscreteSpace, Spaces
from daedalus.protocol.spec import RunSpec

from .kernel import Kernel, Process
from .ledger import Ledger
from .network import Link, Network
from .primitives import Event
from .settings import RUN

_SPACES = Spaces(observation=ArraySpace(shape=(4,), dtype="float32"), action=DiscreteSpace(count=2))
_FALSE = np.zeros((1, 1), np.bool_)
_ZERO = np.zeros((1, 1), np.float32)


class Runtime:
    """In place of OnnxRuntime: a policy that is never run."""

    def __init__(self, model: bytes) -> None:
        assert model


class ScriptedCollector:
    """A Collector whose rollouts carry a number of their own and the weights that they were made with."""

    def __init__(self, actor: "ActorProcess") -> None:
        self._actor = actor
        self._snapshot: Snapshot | None = None

    def prepare(self, spec: RunSpec) -> tuple[Spaces, int]:
        self._actor.pass_time(0.1)
        return _SPACES, 1

    def begin(self, runtime: PolicyRuntime, spec: RunSpec, seed: int) -> None:
        self._snapshot = None

    def load(self, snapshot: Snapshot) -> None:
        self._snapshot = snapshot

    def has_rollout(self) -> bool:
        return True

    def collect(self, identity: RolloutIdentity, *_: object) -> Rollout:
        actor, snapshot = self._actor, self._snapshot
        assert snapshot is not None
        actor.ledger.loaded(snapshot, identity.learner_epoch)
        number = actor.ledger.collect(identity)
        actor.pass_time(actor.collect_seconds)
        frames = np.zeros((2, 1, 4), np.float32)
        frames[0, 0] = [*snapshot.weights["w"], number]
        return Rollout(
            identity=identity,
            policy_version=snapshot.policy_version,
            frames=frames,
            initial_state=np.zeros((1, 0), np.float32),
            actions=np.zeros((1, 1), np.int64),
            behaviour_log_probs=_ZERO,
            rewards=_ZERO,
            terminated=_FALSE,
            truncated=_FALSE,
            valid=~_FALSE,
            episode_returns=np.zeros(0, np.float32),
            episode_lengths=np.zeros(0, np.int32),
        )

    def close(self) -> None:
        pass


@dataclass(slots=True)
class ActorProcess:
    """One incarnation of an actor."""

    kernel: Kernel
    network: Network
    ledger: Ledger
    name: str
    incarnation: int
    link_choice: str
    collect_seconds: float
    on_end: Callable[["ActorProcess"], None]
    process: Process = field(init=False)
    link: Link = field(init=False)
    stop: Event = field(init=False)
    service: ActorService = field(init=False)
    hang_seconds: float = 0.0  # how long the next rollout hangs
    outcome: str = ""  # why the process ended

    def start(self) -> None:
        """Start the process."""
        self.process = Process(self.kernel, f"{self.name}.{self.incarnation}")
        self.link = Link(self.network, self.process)
        self.stop = Event(self.kernel)
        config = ActorConfig(
            name=self.name,
            incarnation=self.incarnation,
            run=RUN,
            link=self.link_choice,  # type: ignore[arg-type]
        )
        self.service = ActorService(config, self.link, self.stop, ScriptedCollector(self))  # type: ignore[arg-type]
        self.kernel.log("start", self.process.name, self.link_choice)
        self.kernel.spawn(self.process, "main", self._main)

    def kill(self) -> None:
        """End the process as SIGKILL does."""
        self.kernel.log("kill", self.process.name)
        self.process.kill()
        self.link.process_killed()
        self._end("killed")

    def pass_time(self, seconds: float) -> None:
        """Let an environment take its time."""
        hang, self.hang_seconds = self.hang_seconds, 0.0
        self.kernel.sleep(seconds * self.kernel.random.uniform(0.5, 1.5) + hang)

    def _main(self) -> None:
        """Do what `daedalus actor` does."""
        try:
            self.service.run()
            outcome = "stopped" if self.stop.is_set() else "run over"
        except NameInUseError:
            outcome = "name in use"
        except ActorError as error:
            outcome = f"error: {error}"
            self.ledger.require(False, f"{self.process.name} gives up: {error}")
        self.link.close()
        self._end(outcome)

    def _end(self, outcome: str) -> None:
        self.kernel.log("end", self.process.name, outcome)
        self.outcome = outcome
        self.on_end(self)
