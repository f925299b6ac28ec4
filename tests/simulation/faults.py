"""The faults of a simulation: kills, stops, freezes, hangs, cuts and false absences."""

from .actors import ActorProcess
from .link import Link
from .network import CALM
from .world import World


def cause(world: World, fault: str, seconds: float) -> None:
    """Cause a fault of a kind of settings.FAULTS, which lasts for some seconds."""
    random = world.kernel.random
    world.kernel.log("fault", fault, f"{seconds:g} s")
    if fault == "new actor":
        if len(world.actors) < len(world.settings.actors):
            world.start_actor(f"a{len(world.actors)}")
    elif fault == "cut router":
        world.network.cut = True
        world.kernel.after(seconds, world.join_router)
    elif "learner" in fault:
        if not world.learner.done:
            _disturb_learner(world, fault, seconds)
    elif world.running:
        _disturb_actor(world, fault, seconds, random.choice(world.running))


def _disturb_learner(world: World, fault: str, seconds: float) -> None:
    learner = world.learner
    if fault == "kill learner":
        learner.kill()
    elif fault == "stop learner":
        learner.stop.set()
    elif fault == "freeze learner":
        _freeze(world, learner.link, seconds)
    elif fault == "hang learner":
        learner.hang_seconds = seconds
    elif not world.settings.embedded:
        if fault == "cut learner":
            _cut(world, learner.link, seconds)
        else:
            learner.link.die()


def _disturb_actor(world: World, fault: str, seconds: float, actor: ActorProcess) -> None:
    if fault == "kill actor":
        world.keep_away(actor, seconds)
        actor.kill()
    elif fault == "stop actor":
        world.keep_away(actor, seconds)
        world.stop_actor(actor)
    elif fault in ("freeze actor", "twin"):
        actor.is_disturbed = True
        _freeze(world, actor.link, seconds)
        if fault == "twin":  # as on another machine, while this one does not respond
            world.start_actor(actor.name)
    elif fault == "hang actor":
        actor.hang_seconds, actor.is_disturbed = seconds, True
    elif fault == "cut actor":
        _cut(world, actor.link, seconds)
    elif fault == "dead actor session":
        actor.link.die()
    else:
        actor.link.flicker()


def _freeze(world: World, link: Link, seconds: float) -> None:
    link.process.freeze()
    link.reachability_changed()
    world.kernel.after(seconds, _thaw, link)


def _thaw(link: Link) -> None:
    if link.process.frozen:
        link.process.thaw()
        link.reachability_changed()


def _cut(world: World, link: Link, seconds: float) -> None:
    link.cut = True
    link.reachability_changed()
    world.kernel.after(seconds, _join, link)


def _join(link: Link) -> None:
    link.cut = False
    link.reachability_changed()


def heal(world: World) -> None:
    """End all faults. A session that is dead must be replaced by its process."""
    world.kernel.log("heal")
    world.network.weather = CALM
    world.join_router()
    for link in world.network.links:
        if link.cut:
            _join(link)
    world.learner.hang_seconds = 0.0
    for actor in world.running:
        actor.hang_seconds = 0.0
    for link in [world.learner.link, *(actor.link for actor in world.running)]:
        _thaw(link)
