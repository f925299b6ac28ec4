"""Faults of actors: kills, freezes and nan rewards; and an account of every rollout."""

import os
import random
import signal
import sys
import time
from collections import Counter
from pathlib import Path

from processes import Running

from benchmarks.chaos.scene import ENDLESS, FailedError, Scene, read_json, say, scene, seconds

_SMALL = ("--set", "collection.envs_per_actor=16")
_WAITED = 2 + 2  # seconds: twice the lease


def kills(count: int) -> list[tuple[str, str]]:
    """Kill actors of `daedalus train` one after another."""
    choose, back, updates = random.Random(1), [], []
    with scene() as here:
        here.start("train", "cartpole", "--actors", 8, "--listen", here.address, *_SMALL, *ENDLESS)
        here.wait("eight actors", lambda: len([each for each in _actors(here) if each.env_steps]) == 8)
        for number in range(count):
            name = f"actor-{choose.randrange(8)}"
            before = here.actor(name)
            assert before is not None
            os.kill(here.process("--name", name), signal.SIGKILL)
            began = time.monotonic()
            updates.append(_longest_pause(here, name, before.lives, before.env_steps))
            back.append(time.monotonic() - began)
            say(f"kill {number + 1} of {count}: {name} back after {back[-1]:.2f} s")
        status = here.status()
        assert status is not None
        lives = sum(each.lives for each in status.actors)
        rejected = dict(status.rollouts_rejected)
    return [
        ("actor kills", f"{count} over 8 actors, {lives} processes, rejected {rejected or 'none'}"),
        ("the first rollout of the restarted actor was trained on after", seconds(back)),
        ("longest time without an update meanwhile", seconds(updates)),
    ]


def barriers(count: int) -> list[tuple[str, str]]:
    """Kill one of three actors under a2c, whose updates wait for every live actor."""
    pauses = []
    with scene() as here:
        actors = _three_by_hand(here, "--algorithm", "a2c", "--actors", 3)
        names = list(actors)
        for number in range(count):
            name = names[number % len(names)]
            actors[name].process.kill()
            killed, others = time.monotonic(), [other for other in names if other != name]
            before = {other: here.env_steps(other) for other in others}
            here.wait(
                "the others",
                lambda others=others, before=before: all(here.env_steps(each) > before[each] for each in others),
            )
            pauses.append(time.monotonic() - killed)
            actors[name].wait()
            actors[name] = here.start("actor", "--connect", here.address, "--name", name)
            here.wait_for_training(name)
    return [("a2c: the others were trained on again after a kill of one of three", seconds(pauses))]


def _three_by_hand(here: Scene, *settings: object) -> dict[str, Running]:
    """Start a learner and three actors, wait until all are trained on, and return the actors by name."""
    here.start("learner", "cartpole", "--listen", here.address, "--run-dir", "run", *settings, *_SMALL, *ENDLESS)
    names = ("actor-a", "actor-b", "actor-c")
    actors = {name: here.start("actor", "--connect", here.address, "--name", name) for name in names}
    for name in names:
        here.wait_for_training(name)
    return actors


def _actors(here: Scene) -> list:
    status = here.status()
    return list(status.actors) if status else []


def _longest_pause(here: Scene, name: str, lives: int, env_steps: int) -> float:
    """Wait until a restarted actor is trained on; return the longest time without an update meanwhile."""
    longest, changed, updates = 0.0, time.monotonic(), -1

    def is_back() -> bool:
        nonlocal longest, changed, updates
        status = here.status()
        if status is None:
            raise FailedError("the learner does not answer")
        now = time.monotonic()
        if status.updates != updates:
            updates, changed = status.updates, now
        longest = max(longest, now - changed)
        actor = next(each for each in status.actors if each.actor == name)
        return actor.lives > lives and actor.env_steps > env_steps

    here.wait(f"a new process of {name}", is_back)
    return longest


def freezes(count: int) -> list[tuple[str, str]]:
    """Stop an actor (SIGSTOP) until the learner notices, then let it continue."""
    seen, back = [], []
    with scene() as here:
        actors = _three_by_hand(here)
        names = list(actors)
        for number in range(count):
            name = names[number % len(names)]
            others = [other for other in names if other != name]
            actors[name].process.send_signal(signal.SIGSTOP)
            try:
                seen.append(here.wait(f"{name} noticed as gone", lambda name=name: not _is_alive(here, name)))
                here.wait_for_training(*others)
            finally:
                actors[name].process.send_signal(signal.SIGCONT)
            back.append(here.wait_for_training(name))
            say(f"freeze {number + 1} of {count}: noticed after {seen[-1]:.2f} s, back after {back[-1]:.2f} s")
        status = here.status()
        assert status is not None
        lives = max(each.lives for each in status.actors)
    late = sum(each > _WAITED for each in seen)
    return [
        (
            "actor freezes",
            f"{count} over 3 actors; {late} noticed later than {_WAITED} s; processes per actor: {lives}",
        ),
        ("the freeze was noticed after", seconds(seen)),
        ("new rollouts of the actor were trained on after", seconds(back)),
    ]


def _is_alive(here: Scene, name: str) -> bool:
    actor = here.actor(name)
    return actor is not None and actor.alive


def accounting(kills: int) -> list[tuple[str, str]]:
    """Kill actors that keep a journal of what they send, and compare the counts of the learner with the journals."""
    choose = random.Random(2)
    with scene() as here:
        here.start("learner", "cartpole", "--listen", here.address, "--run-dir", "run", *_SMALL, *ENDLESS)
        names = ["actor-a", "actor-b", "actor-c"]
        journal = here.folder / "journal"
        command = [sys.executable, str(Path(__file__).with_name("journal.py")), here.address]
        actors = {}

        def begin(name: str, life: int) -> None:
            actors[name] = here.run([*command, name, f"{journal}-{name}-{life}"])

        for name in names:
            begin(name, 0)
            here.wait_for_training(name)
        for number in range(kills):
            name = choose.choice(names)
            time.sleep(choose.uniform(0.0, 0.5))
            actors[name].process.kill()
            actors[name].wait()
            begin(name, number + 1)
            here.wait_for_training(name)
        for actor in actors.values():
            actor.process.kill()
            actor.wait()
        here.wait("all actors gone", lambda: not any(each.alive for each in _actors(here)))
        here.wait("the end of the queue", lambda: (now := here.status()) is not None and not now.queue_bytes)
        status = here.status()
        assert status is not None
        sent, answered = _journals(here.folder, journal)
    accepted = sum(each.rollouts_accepted for each in status.actors)
    rejected = Counter[str]()
    for each in status.actors:
        rejected.update(each.rollouts_rejected)
    again = rejected.pop("duplicate", 0)
    lost = sent - accepted - rejected.total()
    most = 2 * (kills + len(names))  # each process had at most two in flight
    if not 0 <= lost <= most or answered["accepted"] > accepted:
        raise FailedError(
            f"{sent} sent, {accepted} accepted, {dict(rejected)} rejected, {lost} lost; answers {answered}"
        )
    return [
        (
            "rollouts sent = accepted + rejected + lost in flight",
            f"{sent:,} = {accepted:,} + {rejected.total():,} + {lost}, over {kills + len(names)} killed processes "
            f"(at most {most} in flight; {again} arrived twice and were accepted once)",
        )
    ]


def _journals(folder: Path, journal: Path) -> tuple[int, Counter[str]]:
    """Return the number of rollouts sent, and the answers by verdict."""
    sent, answers = 0, Counter[str]()
    for path in folder.glob(f"{journal.name}-*"):
        lines = path.read_text().split("\n")
        sent += len({line for line in lines if line.startswith("sent ")})
        answers.update(line.split()[2] for line in lines if line.startswith("answered "))
    return sent, answers


def solve(seeds: int) -> list[tuple[str, str]]:
    """Solve CartPole while an actor is killed every 5 s and one rollout in a hundred contains a nan."""
    taken, poisoned, killed = [], 0, 0
    for seed in range(1, seeds + 1):
        with scene() as here:
            poison = Path(__file__).with_name("poison.py").read_text()
            (here.folder / "poison.py").write_text(poison)
            options = ("--wrap", "poison:poisoned", "--env-steps", 20_000_000, "--seed", seed, "--run-dir", "run")
            training = here.start("train", "cartpole", "--listen", here.address, *options)
            next_kill = time.monotonic() + 5.0
            choose, bad = random.Random(seed), 0
            while training.process.poll() is None:
                status = here.status()
                if status is not None:
                    bad = status.rollouts_rejected.get("unfit", 0)
                if status is not None and time.monotonic() > next_kill:
                    actor = here.find_process("--name", f"actor-{choose.randrange(2)}")
                    if actor is not None:  # else it is restarting, or the run has ended
                        os.kill(actor, signal.SIGKILL)
                        next_kill, killed = time.monotonic() + 5.0, killed + 1
                time.sleep(0.1)
            if training.wait() != 0:
                raise FailedError(training.output)
            summary = read_json(here.folder / "run" / "summary.json")
            bad = summary["rollouts_rejected"].get("unfit", bad)
            share = bad / (bad + summary["rollouts_accepted"])
            poisoned += bad
            taken.append(summary["seconds_to_target"])
            say(f"seed {seed}: solved after {taken[-1]:.1f} s, {share:.1%} of the rollouts poisoned")
    return [
        (
            "CartPole, an actor killed every 5 s, 1 % of the rollouts poisoned",
            f"solved with {len(taken)} of {seeds} seeds; {seconds(taken)}; "
            f"{killed} kills, {poisoned} rollouts rejected",
        )
    ]
