"""One simulation: a run of a learner and its actors from a seed, with faults at first and without faults at last."""

import contextlib
import queue
import sys
import threading
import time
from collections.abc import Iterator
from dataclasses import dataclass
from random import Random
from types import ModuleType
from typing import Any

from daedalus.learner.serving import actor_server  # noqa: F401 - imports all modules that are patched
from daedalus.protocol import codec as real_codec

from . import actors, codec, faults, primitives
from .kernel import Kernel
from .settings import Settings, draw
from .world import World

_PROGRESS_SECONDS = 150.0  # after the last fault: every actor is trained on again
_END_SECONDS = 15.0  # after the end of the run: every actor has ended


@dataclass(frozen=True, slots=True, kw_only=True)
class Result:
    """What a simulation found."""

    seed: int
    failure: BaseException | None
    trace: list[tuple[float, str, tuple[Any, ...]]]
    virtual_seconds: float
    seconds_to_progress: float  # after the last fault
    longest_stop: float  # seconds from a stop to the end of a process
    rollouts: int

    @property
    def lines(self) -> list[str]:
        """The trace, one event a line."""
        return [f"{at:10.4f}  {event:<18} {' '.join(map(str, facts))}" for at, event, facts in self.trace]


def simulate(seed: int) -> Result:
    """Run the simulation of a seed."""
    settings = draw(seed)
    kernel = Kernel(Random(seed + 2**32), settings.preemption, _fine_files() if settings.fine else frozenset())
    world = World(kernel, settings)
    seconds_to_progress = 0.0
    with _patched(kernel, settings):
        try:
            _faulty_phase(world)
            seconds_to_progress = _await_progress(world)
            _require_no_loss(world)
            _end(world)
        except Exception as error:
            kernel.fail(error)
        finally:
            kernel.close()
    return Result(
        seed=seed,
        failure=kernel.failure,
        trace=kernel.trace,
        virtual_seconds=kernel.now,
        seconds_to_progress=seconds_to_progress,
        longest_stop=world.longest_stop,
        rollouts=len(world.ledger.collected),
    )


def services() -> list[ModuleType]:
    """Return the modules of the learner's services, whose threads and time are simulated."""
    return _modules("daedalus.learner.serving.")


def _modules(*prefixes: str) -> list[ModuleType]:
    return [module for name, module in list(sys.modules.items()) if name.startswith(prefixes)]


def _fine_files() -> frozenset[str]:
    return frozenset(str(module.__file__) for module in services())


@contextlib.contextmanager
def _patched(kernel: Kernel, settings: Settings) -> Iterator[None]:
    """Give the learner's services the kernel's threads and time, and messages that travel as objects to all."""
    fakes = primitives.modules(kernel)
    replacements: dict[int, Any] = {
        id(threading): fakes["threading"],
        id(time): fakes["time"],
        id(queue): fakes["queue"],
    }
    constants = {
        "POLL_SECONDS": settings.poll_seconds,
        "_PATIENCE_SECONDS": settings.patience_seconds,
        "PART_BYTES": 64,  # so that a compact snapshot has several parts
    }
    codecs: dict[int, Any] = {id(real_codec.encode): codec.encode, id(real_codec.decode): codec.decode}
    talking = services() + _modules("daedalus.actor.session.", actors.__name__)
    with contextlib.ExitStack() as patches:
        for module in services():
            _replace(patches, module, replacements, constants)
        for module in [] if settings.real_codec else talking:
            _replace(patches, module, codecs, {})
        yield


def _replace(
    patches: contextlib.ExitStack, module: ModuleType, replacements: dict[int, Any], constants: dict[str, Any]
) -> None:
    """Replace values of a module, by identity or by name, until the patches end."""
    for name, value in list(vars(module).items()):
        if id(value) in replacements or name in constants:
            patches.callback(setattr, module, name, value)
            setattr(module, name, constants.get(name, replacements.get(id(value))))


def _faulty_phase(world: World) -> None:
    """Start the run, cause the faults, and end them."""
    kernel, settings = world.kernel, world.settings
    world.start()
    for at, fault, seconds in settings.faults:
        kernel.sleep(max(at - kernel.now, 0.0))
        faults.cause(world, fault, seconds)
    kernel.sleep(max(settings.faulty_seconds - kernel.now, 0.0))
    faults.heal(world)


def _await_progress(world: World) -> float:
    """Wait until each actor was trained on with a policy of after the faults; return the seconds that it took."""
    kernel, freshest = world.kernel, world.ledger.freshest
    began = kernel.now
    while True:
        late = [name for name in world.actors if freshest.get(name, -1.0) <= began]
        server = None if world.learner.done else world.learner.server
        live = frozenset[str]() if server is None else server.context.fleet.live
        taken = kernel.now - began
        if not late and live == world.actors.keys():
            return taken
        world.ledger.require(
            taken < _PROGRESS_SECONDS, f"{taken:g} s without faults: no progress of", late, "live are", sorted(live)
        )
        kernel.sleep(0.5)


def _require_no_loss(world: World) -> None:
    """Check that the learner has decided about each rollout of the present sessions, unless it is in flight."""
    learner = world.learner
    for actor in world.running:
        uploads = actor.session.uploads.in_flight.rollouts
        for identity in world.ledger.collected:
            if (identity.incarnation, identity.learner_epoch) == (actor.incarnation, learner.epoch):
                is_waiting = identity.sequence in uploads or identity.sequence >= actor.session.sequence
                world.ledger.require(is_waiting or learner.life.has_verdict(identity), "lost:", identity)


def _end(world: World) -> None:
    """End the run; everybody must notice."""
    kernel, learner = world.kernel, world.learner
    world.supervised = False
    if world.settings.ends_by == "finish":
        fleet = {} if learner.server is None else learner.server.context.fleet.actors
        joined = [actor for actor in world.running if fleet[actor.name].incarnation == actor.incarnation]
        learner.is_finished = world.ledger.is_finished = True
        end = kernel.now + _END_SECONDS
        while left := [actor.process.name for actor in joined if not actor.outcome]:
            world.ledger.require(kernel.now < end, left, f"did not end {_END_SECONDS:g} s after the end of the run")
            kernel.sleep(0.1)
    for actor in world.running:
        actor.is_disturbed = False
        world.stop_actor(actor)
    while world.running:
        kernel.sleep(0.1)
    learner.stop.set()
    end = kernel.now + 5.0 + world.settings.poll_seconds
    while not learner.done:
        world.ledger.require(kernel.now < end, "the learner does not end")
        kernel.sleep(0.1)
