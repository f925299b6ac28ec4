"""Slow simulators that fill a replay buffer, while actors are killed and their learner is restarted."""

import random
import signal
import statistics
import time
from collections import Counter, defaultdict
from pathlib import Path

import safetensors.numpy
from processes import Running

from benchmarks.chaos.journal import digests
from benchmarks.chaos.scene import ENDLESS, FailedError, JournalActors, Scene, say, scene
from benchmarks.slow_actors import MODULE, provide_environment

_ACTORS = 8
_CHECKPOINT_SECONDS = 5  # what a learner that is killed may lose
_TASK = ("--env", f"{MODULE}:SlowReacher-v0", "--allow-module", MODULE, "--algorithm", "sac", "--run-dir", "run")
_SETTINGS = (
    "policy.hidden=[64,64]",
    "training.replay_begin=200",
    "training.target_episodes=24",
    f"service.checkpoint_seconds={_CHECKPOINT_SECONDS}",
)
# Of the last training episodes, of 50 steps each: those of all actors end at the same time, and a mean of long ones
# would come late.
_RETURN = -8.0
_KILL_SECONDS = 60.0


def replay(kills: int) -> list[tuple[str, str]]:
    """Kill eight actors of 50 ms a step, and restart the learner by SIGTERM and by SIGKILL.

    Every row of the saved buffer must be one that an actor has sent, none may be there twice, and each row of a rollout
    that was accepted must be there, unless the learner was killed after it, before its next checkpoint. One actor sends
    all rollouts twice.
    """
    choose = random.Random(12)
    restarts = {kills // 3: signal.SIGTERM, 2 * kills // 3: signal.SIGKILL}
    with scene() as here:
        provide_environment(here.folder)
        here.router()
        learner = _learner(here, "--resume")
        actors = JournalActors(here, _ACTORS, ("rows", MODULE))
        ended = list[int]()  # epochs of learners that were killed
        for number in range(kills):
            if number in restarts:
                status = here.status()
                assert status is not None
                if restarts[number] == signal.SIGKILL:
                    ended.append(status.learner_epoch)
                learner.process.send_signal(restarts[number])
                learner.wait()
                learner = _learner(here, "--resume")
                say(f"the learner is restarted after {restarts[number].name}")
            name = actors.kill_one(choose)
            say(f"kill {number + 1} of {kills}: {name} is back")
        actors.end()
        learner.process.send_signal(signal.SIGTERM)
        learner.wait()
        stored = _stored(here.folder / "run" / "replay")
        lines = actors.lines()
    rows, answers = dict[str, list[str]](), defaultdict[str, set[str]](set)
    for kind, name, *rest in (line.split(" ") for line in lines):
        if kind == "rows":
            rows[name] = rest
        elif kind == "answered":
            answers[name].add(rest[0])
    twice = [row for row, count in stored.items() if count > 1]
    foreign = stored.keys() - {row for each in rows.values() for row in each}
    accepted = {name for name, given in answers.items() if "accepted" in given}
    missing = {name for name in accepted if not stored.keys() >= set(rows[name])}
    excused = {name for name in missing if int(name.split("/")[0]) in ended}
    sent, kept = sum(map(len, rows.values())), stored.total()
    most = 2 * (kills + len(restarts) * _ACTORS + _ACTORS)
    unanswered = len(rows) - len(accepted)
    if twice or foreign or missing - excused:
        raise FailedError(
            f"{len(twice)} rows are in the buffer twice, {len(foreign)} were never sent, and those of "
            f"{len(missing - excused)} accepted rollouts are lost"
        )
    return [
        (
            "rows sent = in the buffer + lost",
            f"{sent:,} = {kept:,} + {sent - kept:,}: none twice, none of {len(accepted):,} accepted rollouts lost but "
            f"{len(excused)} after the last checkpoint of a learner that was killed; {unanswered} rollouts in flight "
            f"(at most {most}), over {kills} kills of {_ACTORS} actors and {len(restarts)} restarts",
        )
    ]


def _learner(here: Scene, *words: object) -> Running:
    settings = [word for setting in _SETTINGS for word in ("--set", setting)]
    return here.start("learner", *_TASK, "--connect", here.address, *settings, *words, *ENDLESS)


def _stored(folder: Path) -> Counter[str]:
    """Return the digests of all rows to learn from of a saved buffer."""
    found = Counter[str]()
    for path in sorted(folder.glob("*/columns.safetensors")):
        arrays = safetensors.numpy.load_file(path)
        names = ("frames/observation", "actions", "rewards", "learned")
        found.update(digests(*(arrays[name].swapaxes(0, 1) for name in names)))
    return found


def simulators(seeds: int) -> list[tuple[str, str]]:
    """Compare the time of one actor and of eight, of which one is killed every minute, to the same return."""
    taken = {count: [_seconds_to_learn(count, seed) for seed in range(1, seeds + 1)] for count in (_ACTORS, 1)}
    ratio = statistics.mean(taken[1]) / statistics.mean(taken[_ACTORS])
    return [
        (
            f"a training return of {_RETURN:g}, 50 ms a step, over a router: {count} actors",
            ", ".join(f"{each:.0f} s" for each in each_taken),
        )
        for count, each_taken in taken.items()
    ] + [(f"{_ACTORS} actors, one killed every minute, are sooner by", f"{ratio:.1f} times")]


def _seconds_to_learn(count: int, seed: int) -> float:
    """Return the seconds from the first env_steps to the return. An actor is killed every minute if it has company."""
    with scene() as here:
        provide_environment(here.folder)
        here.router()
        _learner(here, "--seed", seed)
        words = ("actor", "--connect", here.address, "--allow-module", MODULE, "--name")
        actors = [here.start(*words, f"actor-{number}") for number in range(count)]
        here.wait_for_training()
        began, killed = time.monotonic(), 0
        while True:
            time.sleep(0.5)
            status = here.status()
            taken = time.monotonic() - began
            if status is not None and (status.episode_return_mean or -1e9) >= _RETURN:
                say(f"{count} actors, seed {seed}: {taken:.0f} s, {status.env_steps} env_steps, {killed} kills")
                return taken
            if count > 1 and taken > _KILL_SECONDS * (killed + 0.5):
                number = killed % count
                actors[number].process.kill()
                actors[number].wait()
                actors[number] = here.start(*words, f"actor-{number}")
                killed += 1
