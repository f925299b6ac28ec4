"""The learner's process: the real actor server, and a loop that takes batches in place of training."""

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from daedalus.learner.run.counters import RunCounters
from daedalus.learner.serving.actor_server import ActorServer
from daedalus.protocol.messages import Rollout
from daedalus.protocol.spaces import Spaces
from daedalus.protocol.status import RunStatus
from daedalus.transport.interface import TransportError

from .kernel import Kernel, Process
from .ledger import Ledger, Life, observe
from .network import Link, Network
from .primitives import Event
from .settings import RUN, Settings

PROGRAM = b"program"


@dataclass(slots=True)
class Disk:
    """The learner's checkpoint: what remains of it when it is killed."""

    version: int = 0
    counters: dict[str, Any] | None = None
    spaces: Spaces | None = None


@dataclass(slots=True)
class LearnerProcess:
    """One life of the learner."""

    kernel: Kernel
    network: Network
    ledger: Ledger
    settings: Settings
    disk: Disk
    epoch: int
    on_end: Callable[[], None]
    process: Process = field(init=False)
    link: Link = field(init=False)
    stop: Event = field(init=False)
    life: Life = field(init=False)
    server: ActorServer = field(init=False)
    is_finished: bool = False  # whether the budget is used up
    done: bool = False

    def start(self) -> None:
        """Start the process."""
        self.life = self.ledger.begin_life(self.epoch)
        self.process = Process(self.kernel, f"learner{self.life.number}")
        self.link = Link(self.network, self.process, is_router=self.settings.embedded)
        self.stop = Event(self.kernel)
        self.kernel.log("start", self.process.name)
        self.kernel.spawn(self.process, "main", self._main)

    def kill(self) -> None:
        """End the process as SIGKILL does."""
        self.kernel.log("kill", self.process.name)
        self.process.kill()
        self.link.process_killed()
        self._ended()

    def _main(self) -> None:
        """Do what daedalus.learner.service does, with sleeping in place of learning."""
        disk, counters = self.disk, RunCounters(100)
        if disk.counters is not None:
            counters.restore(disk.counters)
        before = counters.rollouts_accepted, counters.rollouts_trained
        server = self.server = ActorServer(
            RUN,
            self.settings.spec,
            self.link,
            counters,
            RunStatus,
            learner_epoch=self.epoch,
            start_version=disk.version,
            spaces=disk.spaces,
        )
        observe(server.rollouts._intake, server.rollouts._buffer, self.ledger, self.life)
        try:
            server.open()
            disk.spaces = server.await_spaces(self.stop)  # type: ignore[arg-type]
            if disk.spaces is not None:
                self._train(counters, before)
        except TransportError as error:
            self.kernel.log("failed", self.process.name, str(error))
        finally:
            server.close("the learner was stopped" if self.stop.is_set() else "the learner has finished")
            self._check(counters, before)
            self.link.close()
            self.kernel.log("end", self.process.name)
            self._ended()

    def _ended(self) -> None:
        self.done = self.life.ended = True
        self.on_end()

    def _train(self, counters: RunCounters, before: tuple[int, int]) -> None:
        kernel, server = self.kernel, self.server
        version = self.disk.version
        server.offer_policy(PROGRAM, 0)
        self.life.published.add(version)
        server.publisher.publish(version, self._weights(version))
        save_at = kernel.now
        while not (self.stop.is_set() or self.is_finished):
            rollouts = server.rollouts.take_batch(version)
            self._check(counters, before)
            if rollouts:
                kernel.sleep(self.settings.train_seconds * kernel.random.random())
                version += self._updates(rollouts)
                self.life.published.add(version)
                server.publisher.publish_if_due(version, self._weights(version), len(rollouts))
            if kernel.now >= save_at:
                self.disk.version, self.disk.counters = version, counters.state(0.0)
                save_at = kernel.now + self.settings.checkpoint_seconds

    def _weights(self, version: int) -> dict[str, np.ndarray]:
        return {"w": np.array(self.ledger.token(self.life.number, version), np.float32)}

    def _updates(self, rollouts: list[Rollout]) -> int:
        return self.settings.spec.training.updates_from(sum(int(rollout.valid.sum()) for rollout in rollouts))

    def _check(self, counters: RunCounters, before: tuple[int, int]) -> None:
        waiting = len(self.server.rollouts._buffer._waiting)  # type: ignore[attr-defined]
        accepted, trained = counters.rollouts_accepted - before[0], counters.rollouts_trained - before[1]
        self.ledger.check_counts(self.life, accepted, trained, waiting)
