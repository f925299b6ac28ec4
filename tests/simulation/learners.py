"""The learner's process: the real actor server, and a loop that takes batches in place of training."""

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from daedalus.learner.run.counters import RunCounters, updates_of
from daedalus.learner.serving.actor_server import ActorServer
from daedalus.learner.serving.run_context import RunContext
from daedalus.protocol.messages import RunStatus
from daedalus.protocol.spaces import Spaces
from daedalus.protocol.uploads import Upload
from daedalus.transport.interface import TransportError

from .kernel import Kernel, SimulationError
from .ledger import Ledger, Life, observe
from .link import Link
from .network import Network
from .primitives import Event
from .process import Process
from .settings import RUN, Settings

_PROGRAM = b"program"


def _no_status() -> RunStatus:
    raise SimulationError("nobody asks a simulated learner for its status")


@dataclass(slots=True)
class Disk:
    """The learner's newest checkpoint: what remains of a learner that was killed."""

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
    server: ActorServer | None = None
    version: int = 0
    is_finished: bool = False  # whether the budget is used up
    hang_seconds: float = 0.0  # how much longer the next update takes
    done: bool = False

    def start(self) -> None:
        """Start the process."""
        self.life = self.ledger.begin_life(self.epoch, self.disk.version)
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
        self._end()

    def _end(self) -> None:
        self.kernel.log("end", self.process.name)
        self.done = True
        self.on_end()

    def _main(self) -> None:
        """Do what daedalus.learner.service does."""
        disk = self.disk
        context = RunContext.begin(Path(RUN), self.settings.spec, self.stop, spaces=disk.spaces)  # type: ignore[arg-type]
        context = replace(context, learner_epoch=self.epoch, start_version=disk.version)
        counters = context.counters
        if disk.counters is not None:
            counters.restore(disk.counters)
        before = counters.rollouts_accepted, counters.rollouts_trained
        server = self.server = ActorServer(context, self.link, _no_status)
        observe(server, self.ledger, self.life)
        try:
            server.open()
            if disk.spaces is None:
                server.await_actor()  # type: ignore[arg-type] - a simulated Event
            disk.spaces = server.context.fleet.spaces
            if disk.spaces is not None:
                self._train(server, counters, before)
                server.close("finished" if self.is_finished else "stopped", finished=self.is_finished)
                if self.is_finished:
                    server.await_departures()  # type: ignore[arg-type]
        except TransportError as error:
            self.kernel.log("failed", self.process.name, str(error))
        finally:
            server.close("stopped")
            self._check(server, counters, before)
            self.link.close()
        self._end()

    def _train(self, server: ActorServer, counters: RunCounters, before: tuple[int, int]) -> None:
        """Take batches, and publish a policy version after each, until the end."""
        kernel = self.kernel
        self.version = self.disk.version
        server.offer_policy(_PROGRAM, 0)
        server.publisher.publish(self.version, self._weights())
        save_at = kernel.now
        while not (self.stop.is_set() or self.is_finished):
            rollouts = server.rollouts.take_batch(self.version)
            self._check(server, counters, before)
            if rollouts:
                hang, self.hang_seconds = self.hang_seconds, 0.0
                kernel.sleep(self.settings.train_seconds * kernel.random.random() + hang)
                self.version += self._updates(rollouts)
                server.rollouts.count_trained(rollouts, [])
                server.publisher.publish_if_due(self.version, lambda: self._weights, len(rollouts))
            if kernel.now >= save_at:
                self.disk.version, self.disk.counters = self.version, counters.state(0.0)
                save_at = kernel.now + self.settings.checkpoint_seconds

    def _weights(self) -> dict[str, np.ndarray]:
        """Return the weights of the present version, which are about to be published."""
        self.life.published[self.version] = self.kernel.now
        return {"w": np.array(self.ledger.token(self.life.number, self.version), np.float32)}

    def _updates(self, rollouts: list[Upload]) -> int:
        return updates_of(self.settings.spec.training, rollouts, memory=False)

    def _check(self, server: ActorServer, counters: RunCounters, before: tuple[int, int]) -> None:
        with server.context.lock:
            waiting = len(server.rollouts._buffer._waiting)  # type: ignore[attr-defined]
            accepted, trained = counters.rollouts_accepted - before[0], counters.rollouts_trained - before[1]
            self.ledger.check_counts(self.life, accepted, trained, waiting)
