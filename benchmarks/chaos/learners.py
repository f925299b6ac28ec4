"""Faults of learners: kills at every stage of saving, stops, and damaged checkpoints."""

import os
import random
import shutil
import signal
import tempfile
import time
from collections import Counter
from pathlib import Path

import numpy as np
from processes import processes_mentioning

from benchmarks.chaos.scene import ENDLESS, LIMIT, FailedError, Scene, say, scene, seconds
from daedalus.learner.run.counters import RunCounters
from daedalus.learner.training.checkpoint import encode_checkpoint, load_newest, save_checkpoint
from daedalus.learner.training.learner import Learner
from daedalus.policy.saving.sealed import DamagedError
from daedalus.protocol.spaces import ArraySpace, DiscreteSpace, Spaces
from daedalus.protocol.spec import EnvironmentSpec, PolicySpec, RunSpec


def kills(count: int) -> list[tuple[str, str]]:
    """Kill the learner of `daedalus train` while it saves and between; the run continues each time."""
    choose, back, stages = random.Random(3), [], Counter[str]()
    with scene() as here:
        saving = ("--set", "service.checkpoint_seconds=0.2", "--set", "policy.hidden=[512,512]")
        few = ("--set", "collection.envs_per_actor=16")
        training = here.start(
            "train", "cartpole", "--listen", here.address, "--run-dir", "fallen", *few, *saving, *ENDLESS
        )
        here.wait_for_training()
        checkpoints = here.folder / "fallen" / "checkpoints"
        here.wait("a checkpoint", lambda: _durable(checkpoints) > -1)
        for number in range(count):
            victim = here.process("--prepared")
            if number % 5:
                stage = _await_stage(checkpoints, choose)
            else:
                time.sleep(choose.uniform(0.0, 0.3))
                stage = "at any time"
            durable, status = _durable(checkpoints), here.status()
            epoch = status.learner_epoch if status else None
            os.kill(victim, signal.SIGKILL)
            stages[stage] += 1
            began = time.monotonic()
            here.wait("the learner", lambda epoch=epoch: _is_restarted(here, epoch))
            here.wait_for_training()
            back.append(time.monotonic() - began)
            line = [line for line in training.lines if "resuming from checkpoint" in line][-1]
            version = int(line.split("checkpoint ")[1].split()[0])
            if version < durable:
                raise FailedError(f"resumed from {version}, but {durable} was on the disk:\n{training.output}")
            say(f"learner kill {number + 1} of {count} ({stage}): back after {back[-1]:.2f} s")
        partial = [entry.name for entry in checkpoints.glob(".*.partial")]
    return [
        ("learner kills", f"{count}: {', '.join(f'{n} {stage}' for stage, n in sorted(stages.items()))}"),
        (
            "resumed from the newest durable checkpoint",
            f"{count} of {count}; unfinished checkpoints left: {len(partial)}",
        ),
        ("the next update came after", seconds(back)),
    ]


def _durable(checkpoints: Path) -> int:
    return max((int(entry.name) for entry in checkpoints.glob("0*")), default=-1)


def _is_restarted(here: Scene, epoch: int | None) -> bool:
    status = here.status()
    return status is not None and status.learner_epoch != epoch


def _await_stage(checkpoints: Path, choose: random.Random) -> str:
    """Wait until a checkpoint is being saved and a random number of its files exist; return a description."""
    files = choose.randrange(6)
    deadline = time.monotonic() + LIMIT
    while time.monotonic() < deadline:
        for partial in checkpoints.glob(".*.partial"):
            try:
                started = len(os.listdir(partial))
            except FileNotFoundError:
                continue
            if started >= files:
                return f"while saving, {started} of 5 files started"
    raise FailedError("no checkpoint was being saved")


def splits(count: int) -> list[tuple[str, str]]:
    """Cut a learner off, continue its run from a copy elsewhere, and heal the cut: the actors keep to the newer one.

    A frozen process stands for the cut: the router ends its connection, and it comes back with its old state.
    """
    healed, trained, names = [], [], [f"actor-{number}" for number in range(4)]
    command = ("learner", "cartpole", "--resume", "--set", "service.checkpoint_seconds=0.5", *ENDLESS, "--run-dir")
    with scene() as here:
        here.router()
        older = here.start(*command, "copy-0/sb", "--connect", here.address)
        stay = ("--run", "sb", "--stay")
        actors = [
            here.start("actor", "--connect", here.address, "--name", name, "--envs", 4, *(stay if number % 2 else ()))
            for number, name in enumerate(names)
        ]
        for number in range(count):
            here.wait_for_training(*names)
            source, copy = (here.folder / f"copy-{each}/sb" for each in (number, number + 1))
            here.wait("a checkpoint", lambda source=source: _durable(source / "checkpoints") > -1)
            older.process.send_signal(signal.SIGSTOP)
            shutil.copytree(source, copy, ignore=shutil.ignore_patterns(".*", "learner.lock"))
            here.wait("the end of the connection", lambda: here.status() is None)
            newer = here.start(*command, copy, "--connect", here.address)
            here.wait("all actors", lambda: (status := here.status()) and status.actors_alive == len(names))
            began = time.monotonic()
            older.process.send_signal(signal.SIGCONT)
            if older.wait() != 7 or "checkpoint saved at" not in older.output:
                raise FailedError(f"the older learner did not step down:\n{older.output}")
            healed.append(time.monotonic() - began)
            for name in names:
                here.wait_for_training(name)
            trained.append(time.monotonic() - began)
            ended = [name for name, actor in zip(names, actors, strict=True) if actor.process.poll() is not None]
            if ended or newer.process.poll() is not None:
                raise FailedError(f"ended: {ended}\n{newer.output}")
            say(f"split {number + 1} of {count}: stepped down after {healed[-1]:.2f} s")
            older = newer
    return [
        ("cuts that healed, with the run continued from a copy", f"{count}: no actor of {len(names)} ended"),
        ("the older learner had saved its checkpoint and ended with 7 after", seconds(healed)),
        ("all actors were trained on again after", seconds(trained)),
    ]


def stops(count: int) -> list[tuple[str, str]]:
    """Stop `daedalus train` with one or two signals while an actor is frozen."""
    taken, saved = [], 0
    shared_memory = set(os.listdir("/dev/shm"))
    for number in range(count):
        with scene() as here:
            training = here.start("train", "cartpole", "--listen", here.address, "--run-dir", "stopped", *ENDLESS)
            here.wait_for_training("actor-0")
            here.wait_for_training("actor-1")
            os.kill(here.process("--name", "actor-0"), signal.SIGSTOP)
            number_of_signal = signal.SIGTERM if number % 2 else signal.SIGINT
            began = time.monotonic()
            training.process.send_signal(number_of_signal)
            if number % 4 > 1:
                training.process.send_signal(number_of_signal)
            training.wait()
            taken.append(time.monotonic() - began)
            left = processes_mentioning(here.address)
            if left:
                raise FailedError(f"{len(left)} processes were left behind")
            saved += _durable(here.folder / "stopped" / "checkpoints") > 0
            say(f"stop {number + 1} of {count}: {taken[-1]:.2f} s")
    segments = set(os.listdir("/dev/shm")) - shared_memory
    return [
        (
            "SIGTERM or SIGINT, once or twice, with a frozen actor",
            f"{seconds(taken)}; {saved} checkpoints; no process and {len(segments)} shared-memory segments left",
        )
    ]


def damaged(count: int) -> list[tuple[str, str]]:
    """Damage the newest checkpoint in many ways: the previous one must be loaded each time."""
    choose = random.Random(4)
    spaces = Spaces(
        observations={"observation": ArraySpace(shape=(4,), dtype="float32")},
        actions={"action": DiscreteSpace(counts=(2,))},
    )
    spec = RunSpec(environment=EnvironmentSpec(id="CartPole-v1"), policy=PolicySpec(hidden=(64, 64)))
    learner = Learner(spec.training, spec.policy, spaces)
    kinds, accepted = Counter[str](), 0
    with tempfile.TemporaryDirectory() as folder:
        run = Path(folder) / "run"

        def save(version: int) -> Path:
            encoded = encode_checkpoint(
                spec=spec,
                spaces=spaces,
                policy_version=version,
                program=learner.program(),
                parameters=learner.weights(),
                state=learner.state(),
                counters=RunCounters(1).state(float(version)),
            )
            return save_checkpoint(run, encoded, keep=2)

        save(1)
        newest = save(2)
        original = Path(folder) / "original"
        shutil.copytree(newest, original)
        for _ in range(count):
            kinds[_damage(newest, choose)] += 1
            try:
                loaded = load_newest(run)
            except DamagedError as error:
                raise FailedError(f"the undamaged checkpoint was not found: {error}") from None
            if loaded.policy.policy_version != 1:
                accepted += 1
            if any(not np.isfinite(array).all() for array in loaded.policy.weights.values()):
                raise FailedError("weights that are not finite")
            shutil.rmtree(newest, ignore_errors=True)  # it was set aside
            shutil.copytree(original, newest)
    return [
        (
            "damaged checkpoints",
            f"{count} ({', '.join(f'{n} {kind}' for kind, n in sorted(kinds.items()))}): {accepted} accepted; "
            f"the previous checkpoint was loaded {count - accepted} times",
        )
    ]


def _damage(directory: Path, choose: random.Random) -> str:
    file = choose.choice(sorted(directory.iterdir()))
    data = bytearray(file.read_bytes())
    kind = choose.choice(["torn", "flipped", "zeroed", "missing", "grown"])
    if kind == "torn":
        data = data[: choose.randrange(len(data))]
    elif kind == "flipped":
        data[choose.randrange(len(data))] ^= 1 << choose.randrange(8)
    elif kind == "zeroed":  # a block that was not written to the disk
        start = choose.randrange(len(data))
        end = min(start + 4096, len(data))
        if not any(data[start:end]):
            data[start] ^= 1
        else:
            data[start:end] = bytes(end - start)
    elif kind == "grown":
        data += bytes(choose.randrange(1, 100))
    if kind == "missing":
        file.unlink()
    else:
        file.write_bytes(data)
    return kind
