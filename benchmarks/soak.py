"""Run CartPole for hours while actors are killed, and check that the memory of every process stays constant.

    python -m benchmarks.soak --minutes 120

Two of four actors are killed in turn, one every 20 s. Memory, threads and open files of the learner, the launcher and
the other two actors are sampled. The slopes leave out the first tenth, the warm-up.
"""

import argparse
import os
import random
import signal
import sys
import time
from pathlib import Path

import numpy as np

from benchmarks.chaos.scene import ENDLESS, Scene, resident_mib, say, scene
from benchmarks.running import machine, table

_KILL_SECONDS = 20.0
_SAMPLE_SECONDS = 5.0


def main() -> int:
    options = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    options.add_argument("--minutes", type=float, default=120.0, help="duration (default: %(default)g)")
    minutes = options.parse_args().minutes
    with scene() as here:
        rows = _soak(here, 60.0 * minutes)
    print(f"{machine()}; {minutes:g} minutes\n")
    print(table(("process", "MiB, first and last", "slope, MiB per hour", "threads", "open files"), rows))
    return 0


def _soak(here: Scene, duration: float) -> list[tuple[str, ...]]:
    choose, kills = random.Random(5), 0
    launcher = here.start(
        "train", "cartpole", "--actors", 4, "--listen", here.address, "--run-dir", "soaking", *ENDLESS
    )
    here.wait_for_training()
    lasting = {
        "launcher": launcher.process.pid,
        "learner": here.process("--prepared"),
        "actor-0": here.process("--name", "actor-0"),
        "actor-1": here.process("--name", "actor-1"),
    }
    samples: dict[str, list[tuple[float, float, int, int]]] = {name: [] for name in lasting}
    began = time.monotonic()
    kill_at, tell_at = began + _KILL_SECONDS, began + 60.0
    while (now := time.monotonic()) < began + duration:
        for name, pid in lasting.items():
            samples[name].append((now - began, resident_mib(pid), *_threads_and_files(pid)))
        if now > kill_at:
            os.kill(here.process("--name", f"actor-{choose.choice((2, 3))}"), signal.SIGKILL)
            kill_at, kills = now + _KILL_SECONDS, kills + 1
        if now > tell_at:
            memory = ", ".join(f"{name} {each[-1][1]:.1f}" for name, each in samples.items())
            say(f"{(now - began) / 60:.0f} min, {kills} kills, MiB: {memory}")
            tell_at = now + 60.0
        time.sleep(_SAMPLE_SECONDS)
    status = here.status()
    assert status is not None
    say(f"{status.updates:,} updates, {status.env_steps:,} env_steps, {kills} kills")
    return [_row(name, each) for name, each in samples.items()]


def _threads_and_files(pid: int) -> tuple[int, int]:
    process = Path(f"/proc/{pid}")
    return len(os.listdir(process / "task")), len(os.listdir(process / "fd"))


def _row(name: str, samples: list[tuple[float, float, int, int]]) -> tuple[str, ...]:
    warm = np.array(samples[len(samples) // 10 :])
    slope = np.polyfit(warm[:, 0] / 3600, warm[:, 1], 1)[0]
    threads, files = warm[:, 2], warm[:, 3]
    return (
        name,
        f"{warm[0, 1]:.1f} and {warm[-1, 1]:.1f}",
        f"{slope:+.2f}",
        f"{threads.min():.0f} to {threads.max():.0f}",
        f"{files.min():.0f} to {files.max():.0f}",
    )


if __name__ == "__main__":
    sys.exit(main())
