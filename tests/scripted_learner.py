"""A learner for tests of actors, which answers as the test says, and an actor on a thread of its own."""

import queue
import threading
from dataclasses import dataclass, replace

import numpy as np
from plain import vector_spaces
from processes import LIMIT

from daedalus.actor.session.actor_config import ActorConfig, LinkChoice
from daedalus.actor.session.actor_service import ActorService, Collector
from daedalus.learner.serving.snapshot_publisher import CompactSnapshotCache
from daedalus.policy.acting.program import export_program
from daedalus.policy.network.actor_critic import ActorCritic
from daedalus.protocol import keys
from daedalus.protocol.codec import decode, encode
from daedalus.protocol.lessons import LessonPlan
from daedalus.protocol.limits import Limits
from daedalus.protocol.messages import (
    Acknowledgement,
    ClientReport,
    Join,
    Message,
    Program,
    Refusal,
    Snapshot,
    SnapshotRequest,
    Welcome,
    program_hash,
)
from daedalus.protocol.spaces import Spaces
from daedalus.protocol.spec import PolicySpec, RunSpec, TrainingSpec
from daedalus.protocol.uploads import Rollout
from daedalus.transport.interface import Request
from daedalus.transport.memory import MemoryNetwork, MemoryTransport

SPEC = RunSpec.model_validate(
    {"environment": {"id": "CartPole-v1"}, "collection": {"envs_per_actor": 2, "rollout_length": 4, "window": 2}}
)
SYNCHRONOUS_SPEC = SPEC.model_copy(update={"training": SPEC.training.model_copy(update={"algorithm": "a2c"})})
SPACES = vector_spaces(4, 2)


@dataclass(frozen=True)
class Policy:
    """A network and the program that a learner would send."""

    network: ActorCritic
    model: bytes

    @classmethod
    def of(cls, spec: PolicySpec, spaces: Spaces, training: TrainingSpec | None = None) -> "Policy":
        network = ActorCritic(spec, spaces, training=training)
        return cls(network, export_program(network, spaces))


POLICY = Policy.of(PolicySpec(), SPACES)


class ScriptedLearner:
    """A learner that answers joins and programs, and leaves every rollout to the test to acknowledge."""

    def __init__(
        self, network: MemoryNetwork, spec: RunSpec = SPEC, epoch: int = 1, policy: Policy = POLICY, run: str = "r"
    ) -> None:
        self.transport, self.run = MemoryTransport(network), run
        self.epoch, self.spec, self.policy = epoch, spec, policy
        self.joins: queue.Queue[Join] = queue.Queue()
        self.rollouts: queue.Queue[Request] = queue.Queue()
        self.reports: queue.Queue[ClientReport] = queue.Queue()
        self.snapshot: bytes = encode(Refusal(code="not_ready", reason=""))
        self.refusal: Refusal | None = None
        self.newer: tuple[str, ...] = ()  # settings that the run changes and this release does not know
        self.epsilons: dict[str, float] = {}  # by actor; 0 of the others
        self.extras: dict[str, np.ndarray] = {}  # in snapshots, besides the weights
        self.lessons: LessonPlan | None = None  # in snapshots
        self.fetches: list[SnapshotRequest] = []  # requests for whole snapshots
        self.compact_fetches: list[SnapshotRequest] = []
        self._compact = CompactSnapshotCache(epoch)
        self.transport.declare_presence(keys.learner(run))
        self.transport.serve(keys.rollouts(run, "*"), self.rollouts.put)
        self.transport.serve(keys.reports(run, "*"), self._report)
        self.transport.serve(keys.snapshots(run), self._newest)
        self.transport.serve(keys.program(run, "*"), self._program)
        self.transport.serve(keys.join(run, "*"), self._join)

    def _join(self, request: Request) -> None:
        message = decode(request.payload, Limits())
        assert isinstance(message, Join)
        self.joins.put(message)
        epsilon = self.epsilons.get(message.actor, 0.0)
        spec = self.spec.for_actors()
        spec = spec.model_copy(update={"changed": spec.changed + self.newer})
        welcome = Welcome(run=self.run, learner_epoch=self.epoch, seed=1, epsilon=epsilon, spec=spec)
        answer: Message = replace(welcome, software="daedalus-rl 9.9") if self.newer else welcome
        request.reply(encode(self.refusal or answer))

    def _report(self, request: Request) -> None:
        message = decode(request.payload, Limits())
        assert isinstance(message, ClientReport)
        self.reports.put(message)
        acknowledge(request, "accepted")

    def _newest(self, request: Request) -> None:
        if not request.size:
            request.reply(self.snapshot)
            return
        message = decode(request.payload, Limits())
        assert isinstance(message, SnapshotRequest)
        if message.compact:
            self.compact_fetches.append(message)
            request.reply(self._compact.answer(message, self.snapshot))
            return
        self.fetches.append(message)
        if self.snapshot:  # otherwise the answer is lost
            request.reply(self.snapshot)

    def _program(self, request: Request) -> None:
        model = self.policy.model
        request.reply(encode(Program.of(model)))

    def publish(self, version: int, *, push: bool = True) -> None:
        weights = {name: parameter.detach().numpy() for name, parameter in self.policy.network.named_parameters()}
        name = program_hash(self.policy.model)
        self.snapshot = encode(
            Snapshot(
                learner_epoch=self.epoch,
                policy_version=version,
                program=name,
                weights=weights | self.extras,
                lessons=self.lessons,
            )
        )
        if push:
            self.transport.publish(keys.snapshots(self.run), self.snapshot)

    def receive(self) -> tuple[Rollout, Request]:
        request = self.rollouts.get(timeout=LIMIT)
        rollout = decode(request.payload, Limits())
        assert isinstance(rollout, Rollout)
        return rollout, request


def acknowledge(request: Request, verdict: str, version: int = 0) -> None:
    request.reply(encode(Acknowledgement(verdict=verdict, policy_version=version)))  # type: ignore[arg-type] - one of its literals


class RunningActor:
    def __init__(
        self,
        network: MemoryNetwork,
        timeout: float | None = None,
        link: LinkChoice = "auto",
        collector: Collector | None = None,
        *,
        run: str = keys.ANY_RUN,
        any_run: bool = False,
        begin: bool = True,
    ) -> None:
        self.stop = threading.Event()
        self.error: Exception | None = None
        self.transport = MemoryTransport(network)
        config = ActorConfig(name="a", incarnation=7, timeout=timeout, link=link, run=run, any_run=any_run)
        self._service = ActorService(config, self.transport, self.stop, collector)
        self._thread = threading.Thread(target=self._run, daemon=True)
        if begin:
            self.begin()

    def begin(self) -> None:
        self._thread.start()

    def _run(self) -> None:
        try:
            self._service.run()
        except Exception as error:
            self.error = error

    def join(self) -> None:
        self._thread.join(LIMIT)
        assert not self._thread.is_alive()

    def end(self) -> None:
        """Stop the actor, which has not failed."""
        self.stop.set()
        self.join()
        assert self.error is None
