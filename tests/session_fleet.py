"""A learner and actors of one run, each on a thread of its own, over the memory transport."""

import io
import itertools
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

from processes import LIMIT, until

from daedalus.actor.collecting.environment_collector import EnvironmentCollector
from daedalus.actor.session.actor_config import ActorConfig
from daedalus.actor.session.actor_service import ActorService
from daedalus.learner.reporting.progress import Progress
from daedalus.learner.run.resuming import Beginning
from daedalus.learner.service import LearnerService, Outcome, Outputs
from daedalus.learner.serving.run_context import RunContext
from daedalus.learner.training.checkpoint import load_newest
from daedalus.protocol import keys
from daedalus.protocol.codec import decode, encode
from daedalus.protocol.limits import Limits
from daedalus.protocol.messages import Message, Order, OrderRequest, StatusReport
from daedalus.protocol.spec import RunSpec
from daedalus.protocol.uploads import Rollout, RolloutIdentity
from daedalus.transport.memory import MemoryNetwork, MemoryTransport

ENDLESS = 10**9


class Worker:
    """A function on a thread of its own, which keeps what the function returns or raises."""

    def __init__(self, work: Callable[[], Any]) -> None:
        self.result: Any = None
        self.error: BaseException | None = None
        self._work = work
        self._thread = threading.Thread(target=self._run, daemon=True)
        self.name = self._thread.name
        self._thread.start()

    def _run(self) -> None:
        try:
            self.result = self._work()
        except BaseException as error:
            self.error = error

    @property
    def ended(self) -> bool:
        return not self._thread.is_alive()

    def join(self) -> Any:
        """Wait for the end of the function and return its result."""
        self._thread.join(LIMIT)
        assert not self._thread.is_alive()
        assert self.error is None, self.error
        return self.result


class GatedCollector(EnvironmentCollector):
    """Collector that waits inside each rollout until the test opens its gate: an environment of any slowness."""

    def __init__(self) -> None:
        super().__init__()
        self.waiting = threading.Event()  # a rollout has begun
        self.gate = threading.Event()

    def collect(self, identity: RolloutIdentity, on_row: Callable[[], None] = lambda: None) -> Rollout:
        self.waiting.set()
        assert self.gate.wait(LIMIT)
        return super().collect(identity, on_row)


class GatedActor(Worker):
    """Actor with a gate."""

    def __init__(self, network: MemoryNetwork, name: str, incarnation: int = 1) -> None:
        self.collector, self.stop = GatedCollector(), threading.Event()
        self._config, self._network = ActorConfig(name=name, incarnation=incarnation), network
        super().__init__(self._play)

    def _play(self) -> Any:
        transport = MemoryTransport(self._network)
        try:
            return ActorService(self._config, transport, self.stop, self.collector).run()
        finally:
            transport.close()

    def open_gate(self) -> None:
        self.collector.gate.set()

    def await_rollout(self) -> None:
        """Wait until the actor has begun a rollout."""
        assert self.collector.waiting.wait(LIMIT)


class LearnerProcess(Worker):
    """What a learner process does, from its start to its end."""

    def __init__(
        self,
        network: MemoryNetwork,
        directory: Path,
        *,
        env_steps: int = ENDLESS,
        resume: bool = False,
        **training: Any,
    ) -> None:
        self.stop = threading.Event()
        directory.mkdir(exist_ok=True)
        self._network, self._directory, self._resume = network, directory, resume
        self._spec = RunSpec.model_validate(
            {
                "environment": {"id": "CartPole-v1"},
                "policy": {"hidden": [8]},
                "collection": {"actors": 1, "envs_per_actor": 2, "rollout_length": 4},
                "training": {"env_steps": env_steps, "batch_rollouts": 1, **training},
                "service": {"checkpoint_seconds": 1e6},  # none within the time limit of a test, unless it is ordered
            }
        )
        super().__init__(self._learn)

    def _learn(self) -> Outcome:
        transport = MemoryTransport(self._network)
        try:
            restored = load_newest(self._directory) if self._resume else None
            context = RunContext.begin(self._directory, self._spec, self.stop, restored=restored)
            outputs = Outputs(progress=Progress(io.StringIO(), self._spec.training.env_steps))
            return LearnerService(context, transport, outputs, Beginning(restored=restored)).run()
        finally:
            transport.close()


def order_to(network: MemoryNetwork, order: Order, actor: str = "", operator: str = "alice", **fields: Any) -> Message:
    """Give an order to the learner of the run `run`, and return its answer."""
    transport, reports = MemoryTransport(network), list[bytes]()
    until(lambda: reports.extend(transport.query(keys.status("run"), timeout=LIMIT)) or reports)
    report = decode(reports[0], Limits())
    assert isinstance(report, StatusReport)
    named = {"run": "run", "learner_epoch": report.status.learner_epoch, "number": next(_numbers), "host": "laptop"}
    message = OrderRequest(order=order, actor=actor, **{**named, **fields})
    (answer,) = transport.query(keys.orders("run", operator), encode(message), timeout=LIMIT)
    return decode(answer, Limits())


_numbers = itertools.count()
