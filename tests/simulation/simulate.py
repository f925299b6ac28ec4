"""One simulation: a run of a learner and its actors from a seed, with faults at first and without faults at last."""

import contextlib
import queue
import sys
import threading
import time
import traceback
from collections.abc import Iterator
from dataclasses import dataclass
from random import Random
from typing import Any

from daedalus.actor.session import service
from daedalus.learner.serving import actor_server  # noqa: F401 - imports all modules that are patched
from daedalus.protocol import codec as real_codec
from daedalus.protocol.limits import Limits
from daedalus.protocol.messages import Acknowledgement, Rollout

from . import codec, primitives
from .actors import ActorProcess, Runtime
from .kernel import Kernel
from .ledger import Ledger
from .learners import Disk, LearnerProcess
from .network import CALM, Link, LinkRequest, Network
from .settings import Settings, draw

_PATCHED = ("daedalus.actor.session.", "daedalus.learner.serving.")
PROGRESS_SECONDS = 150.0  # after the last fault: every actor is trained on again
END_SECONDS = 30.0  # after the end of the run: every actor has ended
STOP_SECONDS = 6.0  # after it was asked to stop: a process has ended


@dataclass(frozen=True, slots=True, kw_only=True)
class Result:
    """What a simulation found."""

    seed: int
    failure: BaseException | None
    trace: list[tuple[float, str, tuple[Any, ...]]]
    virtual_seconds: float
    seconds_to_progress: float  # after the last fault
    rollouts: int

    @property
    def text(self) -> str:
        """The trace, one event a line, and the failure."""
        lines = [f"{at:10.4f}  {event:<18} {' '.join(map(str, facts))}" for at, event, facts in self.trace]
        if self.failure is not None:
            lines += traceback.format_exception(self.failure)
        return "\n".join(lines)


def simulate(seed: int) -> Result:
    """Run the simulation of a seed."""
    settings = draw(seed)
    kernel = Kernel(Random(seed + 2**32), settings.preemption)
    world = World(kernel, settings)
    with _patched(kernel, objects=not settings.real_codec):
        try:
            world.run()
        except Exception as error:
            kernel.fail(error)
        finally:
            kernel.close()
    return Result(
        seed=seed,
        failure=kernel.failure,
        trace=kernel.trace,
        virtual_seconds=kernel.now,
        seconds_to_progress=world.seconds_to_progress,
        rollouts=len(world.ledger.collected),
    )


@contextlib.contextmanager
def _patched(kernel: Kernel, *, objects: bool) -> Iterator[None]:
    """Give the services the kernel's threads and time, and a policy that is never run."""
    replaced: list[tuple[Any, str, Any]] = []
    fakes = primitives.modules(kernel)
    replacements: dict[int, Any] = {
        id(threading): fakes["threading"],
        id(time): fakes["time"],
        id(queue): fakes["queue"],
        id(service.OnnxRuntime): Runtime,
    }
    if objects:
        replacements |= {id(real_codec.encode): codec.encode, id(real_codec.decode): codec.decode}
    for name, module in list(sys.modules.items()):
        if name.startswith(_PATCHED):
            for attribute, value in list(vars(module).items()):
                if id(value) in replacements:
                    replaced.append((module, attribute, value))
                    setattr(module, attribute, replacements[id(value)])
    try:
        yield
    finally:
        for module, attribute, value in replaced:
            setattr(module, attribute, value)


class World:
    """The processes of a simulation, their supervision, and the faults."""

    def __init__(self, kernel: Kernel, settings: Settings) -> None:
        self.kernel, self.settings, self.random = kernel, settings, kernel.random
        self.network = Network(kernel, settings.weather)
        self.network.on_reply = self._on_reply
        self.ledger = Ledger(kernel, settings.spec)
        self.disk = Disk()
        self.actors: dict[str, ActorProcess] = {}  # the newest incarnation of each
        self.seconds_to_progress = 0.0
        self._supervised = True
        self._absent: dict[str, float] = {}  # seconds until an actor that was stopped comes back
        self._incarnations = 0
        self._lives = 0

    def run(self) -> None:
        """Run the faulty phase, the calm phase and the end of the run."""
        self._start_learner()
        for index in range(self.settings.spec.collection.actors):
            self.kernel.after(self.random.random(), self._start_actor, f"a{index}")
        self._cause_faults()
        self._heal()
        self._await_progress()
        self._check_losses()
        self._end()

    # ------------------------------------------------------------------------------------------- supervision

    def _start_learner(self) -> None:
        self._lives += 1
        self.network.cut = False
        self.learner = LearnerProcess(
            self.kernel,
            self.network,
            self.ledger,
            self.settings,
            self.disk,
            epoch=1000 + self._lives,
            on_end=self._on_learner_end,
        )
        self.learner.start()

    def _on_learner_end(self) -> None:
        if self.settings.embedded:
            self.kernel.after(self.network.longest_delay, self._lose_router)
        if self._supervised:
            self.kernel.after(self.random.uniform(0.1, 3.0), self._start_learner)

    def _start_actor(self, name: str) -> None:
        self._incarnations += 1
        index = int(name[1:])
        actor = ActorProcess(
            self.kernel,
            self.network,
            self.ledger,
            name=name,
            incarnation=self._incarnations,
            link_choice=self.settings.links[index],
            collect_seconds=self.settings.collect_seconds[index],
            on_end=self._on_actor_end,
        )
        self.actors[name] = actor
        actor.start()

    def _on_actor_end(self, actor: ActorProcess) -> None:
        if self._supervised:
            pause = self._absent.pop(actor.name, self.random.uniform(0.1, 2.0))
            self.kernel.after(pause, self._start_actor, actor.name)

    # ------------------------------------------------------------------------------------------------ faults

    def _cause_faults(self) -> None:
        for at, fault, seconds in self.settings.faults:
            self.kernel.sleep(max(at - self.kernel.now, 0.0))
            actor = self.random.choice(list(self.actors.values())) if self.actors else None
            self._cause(fault, seconds, actor)
        self.kernel.sleep(max(self.settings.faulty_seconds - self.kernel.now, 0.0))

    def _cause(self, fault: str, seconds: float, actor: ActorProcess | None) -> None:
        self.kernel.log("fault", fault, f"{seconds:g} s", actor.process.name if actor else "")
        learner = self.learner
        if fault == "new actor" and len(self.actors) < len(self.settings.links):
            self._start_actor(f"a{len(self.actors)}")
        elif fault == "cut router":
            self.network.cut = True
            self.kernel.after(seconds, self._join_router)
        elif fault.endswith("learner"):
            if not learner.done:
                self._disturb_learner(fault, seconds)
        elif actor is not None and not actor.outcome:
            self._disturb_actor(fault, seconds, actor)

    def _disturb_learner(self, fault: str, seconds: float) -> None:
        learner = self.learner
        if fault == "kill learner":
            learner.kill()
        elif fault == "stop learner":
            learner.stop.set()
        elif fault == "freeze learner":
            learner.process.freeze()
            self.kernel.after(seconds, learner.process.thaw)
        elif not self.settings.embedded:
            self._cut(learner.link, seconds)

    def _disturb_actor(self, fault: str, seconds: float, actor: ActorProcess) -> None:
        if fault == "kill actor":
            self._absent[actor.name] = seconds
            actor.kill()
        elif fault == "stop actor":
            self._absent[actor.name] = seconds
            actor.stop.set()
        elif fault == "freeze actor":
            actor.process.freeze()
            self.kernel.after(seconds, actor.process.thaw)
        elif fault == "hang environment":
            actor.hang_seconds = seconds
        elif fault == "cut actor":
            self._cut(actor.link, seconds)
        elif fault == "dead session":
            actor.link.dead = True
            actor.link.reachability_changed()
        else:
            actor.link.flicker()

    def _cut(self, link: Link, seconds: float) -> None:
        link.cut = True
        link.reachability_changed()
        self.kernel.after(seconds, self._join_link, link)

    def _join_link(self, link: Link) -> None:
        link.cut = False
        link.reachability_changed()

    def _lose_router(self) -> None:
        if self.learner.done:
            self.network.cut = True

    def _join_router(self) -> None:
        self.network.cut = self.settings.embedded and self.learner.done

    def _heal(self) -> None:
        """End all faults. A dead session is not healed from outside."""
        self.kernel.log("heal")
        self.network.weather = CALM
        self._join_router()
        for link in self.network.links:
            if link.cut:
                self._join_link(link)
        for process in [self.learner.process, *(actor.process for actor in self.actors.values())]:
            if process.frozen:
                process.thaw()
        for actor in self.actors.values():
            actor.hang_seconds = 0.0

    # ----------------------------------------------------------------------------------------------- the end

    def _await_progress(self) -> None:
        """Wait until every actor was trained on again."""
        began, trained = self.kernel.now, self.ledger.last_collected_trained
        while True:
            late = [name for name in self.actors if trained.get(name, -1.0) <= began]
            self.seconds_to_progress = self.kernel.now - began
            if not late:
                return
            self.ledger.require(
                self.seconds_to_progress < PROGRESS_SECONDS,
                f"{', '.join(late)} not trained on for {PROGRESS_SECONDS:g} s without faults",
            )
            self.kernel.sleep(0.5)

    def _check_losses(self) -> None:
        """Check that no rollout of a session that goes on was lost."""
        for actor in self.actors.values():
            if actor.outcome or self.learner.done:
                continue
            waiting = actor.service._uploads.in_flight.rollouts
            for collected in self.ledger.collected:
                identity = collected.identity
                if (identity.actor, identity.incarnation) != (actor.name, actor.incarnation):
                    continue
                if identity.learner_epoch == self.learner.epoch and identity.sequence not in waiting:
                    in_progress = identity.sequence >= actor.service._sequence
                    self.ledger.require(in_progress or self.learner.life.has_verdict(identity), f"{identity} was lost")

    def _end(self) -> None:
        """End the run; everybody must notice."""
        self._supervised = False
        actors = list(self.actors.values())
        if self.settings.ends_by == "finish":
            self.learner.is_finished = True
            actors = [actor for actor in actors if actor.link_choice == "lan"]
            self._await_ends(actors, END_SECONDS, "the end of the run")
        else:
            for actor in actors:
                actor.stop.set()
            self._await_ends(actors, STOP_SECONDS, "its stop")
            self.learner.stop.set()
        began = self.kernel.now
        while not self.learner.done:
            self.ledger.require(self.kernel.now < began + STOP_SECONDS, "the learner does not end")
            self.kernel.sleep(0.1)

    def _await_ends(self, actors: list[ActorProcess], seconds: float, reason: str) -> None:
        end = self.kernel.now + seconds
        while left := [actor.process.name for actor in actors if not actor.outcome]:
            self.ledger.require(self.kernel.now < end, f"{', '.join(left)} did not end {seconds:g} s after {reason}")
            self.kernel.sleep(0.1)

    def _on_reply(self, request: LinkRequest, payload: bytes) -> None:
        if "/rollouts/" not in request.key:
            return
        rollout = _decoded(request.payload)
        answer = _decoded(payload)
        assert isinstance(rollout, Rollout)
        assert isinstance(answer, Acknowledgement)
        life = next(life for life in self.ledger.lives if request.server.process.name == f"learner{life.number}")
        self.ledger.answered(life, rollout.identity, answer)


def _decoded(data: bytes) -> object:
    return codec.decode(data, Limits())
