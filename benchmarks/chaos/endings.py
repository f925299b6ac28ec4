"""Ends of runs and planned restarts of learners, with actors whose environments are slow."""

import itertools
import signal
import sys
import time
from collections.abc import Callable
from contextlib import closing

from processes import Running

from benchmarks.chaos.scene import ENDLESS, LIMIT, FailedError, Scene, say, scene, seconds
from benchmarks.slow_actors import MODULE, provide_environment
from daedalus.protocol import keys
from daedalus.protocol.codec import encode
from daedalus.protocol.messages import Refusal, Welcome
from daedalus.protocol.spec import EnvironmentSpec, RunSpec
from daedalus.transport.zenoh_transport import connect

_EACH = 10  # actors in a run
_ENVIRONMENT = """import gymnasium

gymnasium.register("Theirs-v0", entry_point="gymnasium.envs.classic_control:CartPoleEnv")
"""
_ROWS, _ENVIRONMENTS = 8, 2
_CASES = tuple(itertools.product((4, 500), ("direct", "router", "direct, --link wan")))  # milliseconds a step, path


def run_ends(count: int) -> list[tuple[str, str]]:
    """End runs while most of the actors are inside a rollout: all of them must leave."""
    left, slowest, waiting = 0, [], 0
    rounds = -(-count // _EACH)
    for number, (milliseconds, path) in zip(range(rounds), itertools.cycle(_CASES), strict=False):
        with scene() as here:
            learner = _learner(here, path, milliseconds)
            actors = _actors(here, path, milliseconds)
            here.wait("all actors", lambda here=here: _trained(here) == _EACH)
            learner.process.send_signal(signal.SIGUSR1)  # the budget is used up
            if learner.wait() != 0:
                raise FailedError(learner.output)
            began = time.monotonic()
            limit = began + 5.0 + 2 * milliseconds / 1000 * _ENVIRONMENTS * _ROWS
            while _ended(actors) < _EACH and time.monotonic() < limit:
                time.sleep(0.02)
            slowest.append(time.monotonic() - began)
            left += _ended(actors)
            waiting += _EACH - _ended(actors)
            say(f"end {number + 1} of {rounds} ({milliseconds} ms a step, {path}): {_ended(actors)} of {_EACH} left")
    return [
        (
            f"ends of {rounds} runs with {_EACH} actors each, 4 or 500 ms a step, direct, by a router, or --link wan",
            f"{waiting} of {left + waiting} actors left waiting",
        ),
        ("the last actor left after the learner by", seconds(slowest)),
    ]


def standing(count: int) -> list[tuple[str, str]]:
    """Disturb a standing fleet by what others start on its router; it must serve the next run that it can play."""
    joined, names = [], [f"standing-{number}" for number in range(4)]
    kinds = (_foreign_release, _unplayable_run, _two_runs)
    with scene() as here:
        here.router()
        fleet = [
            here.start("actor", "--connect", here.address, "--name", name, "--envs", 4, "--stay") for name in names
        ]
        for number, disturb in zip(range(count), itertools.cycle(kinds), strict=False):
            seen = [len(actor.lines) for actor in fleet]
            disturb(here, number, lambda fleet=fleet, seen=seen: _refused_since(fleet, seen))
            began = time.monotonic()
            run = here.start("learner", "cartpole", "--connect", here.address, "--run-dir", f"ours-{number}", *ENDLESS)
            here.wait("all actors", lambda: (status := here.status()) and status.actors_alive == len(names))
            joined.append(time.monotonic() - began)
            if any(actor.process.poll() is not None for actor in fleet):
                raise FailedError("\n".join(actor.output[-1000:] for actor in fleet))
            run.process.send_signal(signal.SIGTERM)
            run.wait()
            for actor in fleet:  # forget the run, to which an actor that has joined keeps
                actor.process.terminate()
                actor.wait()
            fleet = [
                here.start("actor", "--connect", here.address, "--name", name, "--envs", 4, "--stay") for name in names
            ]
            say(f"disturbance {number + 1} of {count} ({disturb.__name__[1:]}): joined after {joined[-1]:.2f} s")
    return [
        (
            "a learner of another release, a run without its module here, two runs",
            f"{count} disturbances: 0 of {len(names)} standing actors ended",
        ),
        ("all of them took part in the next run after", seconds(joined)),
    ]


def _refused_since(fleet: list[Running], seen: list[int]) -> bool:
    """Return whether each actor has logged since that it tries again."""
    return all(
        any("trying again" in line for line in actor.lines[first:]) for actor, first in zip(fleet, seen, strict=True)
    )


def _foreign_release(here: Scene, number: int, refused: Callable[[], bool]) -> None:
    answer = bytearray(encode(Refusal(code="not_ready", reason="")))
    answer[4] += 1  # the version
    with closing(connect([here.address])) as foreign:
        foreign.serve(keys.join(f"foreign-{number}", "*"), lambda request: request.reply(bytes(answer)))
        here.wait("refusals", refused)


def _unplayable_run(here: Scene, number: int, refused: Callable[[], bool]) -> None:
    (here.folder / "theirs.py").write_text(_ENVIRONMENT)
    options = ("--env", "theirs:Theirs-v0", "--connect", here.address, "--run-dir", f"theirs-{number}")
    theirs = here.start("learner", *options)
    here.wait("refusals", refused)
    theirs.end()


def _two_runs(here: Scene, number: int, refused: Callable[[], bool]) -> None:
    answer = [
        encode(
            Welcome(
                run=f"{name}-{number}",
                learner_epoch=1,
                seed=1,
                spec=RunSpec(environment=EnvironmentSpec(id="x")).for_actors(),
            )
        )
        for name in ("one", "two")
    ]
    with closing(connect([here.address])) as first, closing(connect([here.address])) as second:
        for transport, name, welcome in zip((first, second), ("one", "two"), answer, strict=True):
            transport.serve(keys.join(f"{name}-{number}", "*"), lambda request, welcome=welcome: request.reply(welcome))
        here.wait("refusals", refused)


def restarts(count: int) -> list[tuple[str, str]]:
    """Stop learners by SIGTERM and resume them: all actors must be trained on again."""
    back, lost = [], 0
    rounds = -(-count // _EACH)
    runs = [path for path in ("direct", "router") for _ in range(-(-rounds // 2))][:rounds]
    for path, group in itertools.groupby(runs):
        with scene() as here:
            learner = _learner(here, path, 4)
            actors = _actors(here, path, 4)
            here.wait("all actors", lambda here=here: _trained(here) == _EACH)
            for number, _ in enumerate(group):
                learner.process.terminate()
                if learner.wait() != 0 or "stopped; checkpoint saved at" not in learner.output:
                    raise FailedError(f"the learner did not stop with a checkpoint:\n{learner.output}")
                began = time.monotonic()
                learner = _learner(here, path, 4, start_router=False)
                while _trained(here) < _EACH and time.monotonic() < began + LIMIT:
                    time.sleep(0.05)
                back.append(time.monotonic() - began)
                lost += _EACH - _trained(here)
                say(f"restart {number + 1} ({path}): {_trained(here)} of {_EACH} back after {back[-1]:.2f} s")
            if _ended(actors):
                raise FailedError(f"{_ended(actors)} actors ended:\n{actors.output}")
    return [
        (
            f"planned restarts of a learner with {_EACH} actors, 4 ms a step, direct and by a router",
            f"{rounds}; {lost} of {rounds * _EACH} actors lost",
        ),
        ("all actors were trained on again after the start of the learner by", seconds(back)),
    ]


def _learner(here: Scene, path: str, milliseconds: int, *, start_router: bool = True) -> Running:
    if path == "router" and start_router:
        here.router()
    provide_environment(here.folder)
    settings = [
        f"environment.kwargs={{seconds={milliseconds / 1000}}}",
        f"collection.envs_per_actor={_ENVIRONMENTS}",
        f"collection.rollout_length={_ROWS}",
    ]
    words = [word for setting in settings for word in ("--set", setting)]
    where = ("--connect" if path == "router" else "--listen", here.address)
    run = ("--env", f"{MODULE}:Slow-v0", *where, "--run-dir", "run", "--resume", *words, *ENDLESS)
    return here.run([sys.executable, "-m", "benchmarks.chaos.finishing_learner", *map(str, run)])


def _actors(here: Scene, path: str, milliseconds: int) -> Running:
    link = "wan" if path.endswith("wan") else "auto"
    rollout = milliseconds / 1000 * _ENVIRONMENTS * _ROWS
    options = ["--link", link, "--stagger", str(max(rollout, 0.2))]
    return here.run([sys.executable, "-m", "benchmarks.slow_actors", here.address, str(_EACH), *options])


def _ended(actors: Running) -> int:
    return sum(line.startswith("ended ") for line in list(actors.lines))


def _trained(here: Scene) -> int:
    """Return the number of actors that this process of the learner has trained on."""
    status = here.status()
    return sum(each.env_steps > 0 and each.alive for each in status.actors) if status else 0
